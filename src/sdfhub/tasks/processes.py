"""The processes of a distributed training end together: where one dies, none waits for it."""

import os
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from lightning.pytorch import Trainer
from lightning.pytorch.utilities.exceptions import SIGTERMException

from sdfhub.errors import SdfhubError

LOST = "another process of this run has died; continue from its last checkpoint"


@contextmanager
def ending_together(trainer: Trainer) -> Iterator[None]:
    """Turns a lost connection into one line, ends a process whose starter has died, and keeps exit statuses.

    Lightning looks after the processes that the first one starts; nobody looks after the first one, for
    which the others would wait until a connection times out.

    Raises:
        SdfhubError: another process of the run has died.
        KeyboardInterrupt, SystemExit: a signal came before the first step; Lightning would exit with 1 or 0.
    """
    if trainer.world_size > 1 and not trainer.is_global_zero:
        threading.Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()
    try:
        yield
    except SIGTERMException as stop:
        raise SystemExit(143) from stop
    except SystemExit as stop:
        if trainer.interrupted and stop.code == 1:
            raise KeyboardInterrupt from stop
        raise
    except RuntimeError as error:  # gloo raises it bare, NCCL a kind of it
        lost = isinstance(error, torch.distributed.DistError) or "onnection" in str(error)
        if trainer.world_size == 1 or not lost:
            raise
        print(
            f"sdfhub: error: {LOST}", file=sys.stderr, flush=True
        )  # now: the others may be ended any moment
        raise SdfhubError(LOST) from error


def _end_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(1)
    print(f"sdfhub: error: {LOST}", file=sys.stderr, flush=True)
    os._exit(1)
