"""Processes that train one run together (ddp): none in a multirun, and none outlives another."""

import logging
import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from lightning.pytorch import Trainer
from lightning.pytorch.utilities.exceptions import SIGTERMException

from sdfhub.errors import SdfhubError

LOST = "another process of this run has died; continue from its last checkpoint"

log = logging.getLogger(__name__)


def refuse_processes_in_multirun(trainer: Trainer) -> None:
    """Refuses a cell whose trainer would start processes: each of them would walk the whole multirun."""
    cluster = getattr(trainer.strategy, "cluster_environment", None)
    starts = trainer.world_size > 1 and not (cluster and cluster.creates_processes_externally)
    if starts and HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN:
        raise SdfhubError(
            "trainer.devices: a cell of a multirun has one device, or processes of SLURM; set 1"
        )


@contextmanager
def ending_together(trainer: Trainer) -> Iterator[None]:
    """Ends a process where another of its run has died, and with status 143 after SIGTERM.

    Lightning watches the processes that the first one starts; nobody watches the first one.
    """
    if trainer.world_size > 1 and not trainer.is_global_zero:
        threading.Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()
    try:
        yield
    except SIGTERMException as stop:
        raise SystemExit(143) from stop  # Lightning's has status 0
    except RuntimeError as error:  # gloo raises it bare, NCCL a kind of it
        if (
            trainer.world_size == 1
            or "onnection" not in str(error)
            and not isinstance(error, torch.distributed.DistError)
        ):
            raise
        raise SdfhubError(LOST) from error


def _end_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(1)
    log.error(LOST)
    os._exit(1)
