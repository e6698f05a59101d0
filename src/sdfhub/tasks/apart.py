"""A cell that several processes train, as a run of its own."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from lightning.pytorch import Trainer

from sdfhub.errors import SdfhubError

CELL = "SDFHUB_CELL"
"""Set in the environment of a cell that runs apart, and of the processes that it starts."""


def must_run_apart(trainer: Trainer) -> bool:
    """Whether this is a cell of a multirun whose trainer would start further processes.

    These are given the same command line: of a multirun they would walk all cells, not help with this one.
    """
    if trainer.world_size == 1 or trainer.strategy.cluster_environment.creates_processes_externally:
        return False
    return HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN


def train_apart(folder: Path) -> dict[str, Any]:
    """Trains the cell that Hydra has composed into `folder` by a command of its own.

    Returns:
        What `metrics.json` holds.

    Raises:
        SdfhubError: it failed; its own last line.
        KeyboardInterrupt, SystemExit: it was stopped, and so is the sweep.
    """
    words = [*HydraConfig.get().overrides.task, f"hydra.run.dir='{folder}'"]
    command = [sys.executable, "-m", "sdfhub", "train", *words]
    child = subprocess.Popen(command, env=os.environ | {CELL: "1"}, stderr=subprocess.PIPE, text=True)
    before = signal.signal(signal.SIGTERM, lambda *_: child.terminate())
    try:
        told = _told(child)
    finally:
        signal.signal(signal.SIGTERM, before)
    if child.returncode == 130:
        raise KeyboardInterrupt
    if child.returncode == 143:
        sys.exit(143)
    if child.returncode:
        last = (told.strip().splitlines() or [f"ended with status {child.returncode}"])[-1]
        raise SdfhubError(last.removeprefix("sdfhub: error: "))
    sys.stderr.write(told)
    return json.loads((folder / "metrics.json").read_text(encoding="utf-8"))


def _told(child: subprocess.Popen) -> str:
    """What it says on stderr until it ends; after Ctrl-C, which it hears too, it finishes its step."""
    while True:
        try:
            return child.communicate()[1]
        except KeyboardInterrupt:
            continue
