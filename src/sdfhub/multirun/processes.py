"""Processes that train one run together (ddp): none in a multirun, and none outlives another."""

import logging
import os
import sys
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
    starts = trainer.world_size > 1 and not trainer.strategy.cluster_environment.creates_processes_externally
    if starts and HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN:
        raise SdfhubError(
            "trainer.devices: a cell of a multirun has one device, or processes started by SLURM; set 1"
        )


@contextmanager
def ending_together(trainer: Trainer) -> Iterator[None]:
    """Ends a process with one line and status 1 where another of its run has died, 143 after SIGTERM.

    Lightning watches the processes that the first one starts; nobody watches the first one.
    """
    if trainer.world_size > 1 and not trainer.is_global_zero:
        threading.Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()
    try:
        yield
    except SIGTERMException as stop:
        raise SystemExit(143) from stop  # Lightning's has status 0
    except RuntimeError as error:  # gloo raises it bare, NCCL a kind of it
        lost = isinstance(error, torch.distributed.DistError) or "onnection" in str(error)
        if trainer.world_size == 1 or not lost:
            raise
        log.error(LOST)
        sys.exit(1)


def _end_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(1)
    log.error(LOST)
    os._exit(1)
