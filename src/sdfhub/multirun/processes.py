"""Processes that train one run together (ddp): none in a multirun."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from lightning.pytorch import Trainer
from lightning.pytorch.utilities.exceptions import SIGTERMException

from sdfhub.errors import SdfhubError

LOST = "another process of this run has died; continue from its last checkpoint"


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
    """Ends a process whose run has lost another one with a line, and with status 143 after SIGTERM."""
    try:
        yield
    except SIGTERMException as stop:
        raise SystemExit(143) from stop  # Lightning's has status 0
    except RuntimeError as error:  # gloo raises it bare, NCCL a kind of it
        is_loss = isinstance(error, torch.distributed.DistError) or "onnection" in str(error)
        if trainer.world_size > 1 and is_loss:
            raise SdfhubError(LOST) from error
        raise
