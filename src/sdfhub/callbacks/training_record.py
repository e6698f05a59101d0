"""Seconds, steps and last losses of a training, for `metrics.json`."""

import platform
import re
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import torch
from torch import Tensor

from sdfhub.model.autodecoder import AutoDecoder

LAST = 20  # steps whose losses are averaged


class TrainingRecord(L.Callback):
    """Seconds, steps and the last losses of a training, also of the processes that it was continued from.

    The clock starts after the first step of a process, in which loops are compiled. It stands still during
    validation and in `clock_stopped`.
    """

    def __init__(self) -> None:
        self._losses: deque[float | Tensor] = deque(maxlen=LAST)  # tensors: a GPU would be waited for
        self._seconds = 0.0  # up to the last start of the clock, in all processes
        self._started: float | None = None
        self.stepped = False  # by this process

    def on_train_batch_end(self, trainer: L.Trainer, module: Any, outputs: Any, *_: Any) -> None:
        if not self.stepped:
            self.stepped, self._started = True, time.perf_counter()
        self._losses.append(outputs["loss"])

    def stop_clock(self, *_: Any) -> None:
        """Counts no seconds from now on."""
        self._seconds, self._started = self._so_far(), None

    def start_clock(self, *_: Any) -> None:
        """Counts seconds again, if the first step has been."""
        self._started = time.perf_counter() if self.stepped else None

    on_validation_start = on_train_end = stop_clock  # type: ignore[assignment]
    on_validation_end = start_clock  # type: ignore[assignment]

    def _so_far(self) -> float:
        return self._seconds + (time.perf_counter() - self._started if self._started else 0.0)

    def state_dict(self) -> dict[str, Any]:
        return {"seconds": self._so_far(), "last": [float(loss) for loss in self._losses]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._seconds = state["seconds"]
        self._losses.extend(state["last"])

    def summary(self, model: AutoDecoder) -> dict[str, Any]:
        """Plain numbers: seconds and steps of the whole training, parameters, loss at its end."""
        return {
            "seconds": self._so_far(),
            "steps": model.global_step,
            "parameters": sum(parameter.numel() for parameter in model.decoder.parameters()),
            "loss": {"end": float(np.mean([float(loss) for loss in self._losses]))} if self._losses else {},
        }


@contextmanager
def clock_stopped(trainer: L.Trainer) -> Iterator[None]:
    """The trainer's `TrainingRecord`, if it has one, counts no seconds within; for callbacks that draw."""
    callbacks: list[L.Callback] = trainer.callbacks  # type: ignore[attr-defined]
    running = [record for record in callbacks if isinstance(record, TrainingRecord) and record._started]
    for record in running:
        record.stop_clock()
    yield
    for record in running:
        record.start_clock()


def made_with(trainer: L.Trainer) -> dict[str, str]:
    """Versions and hardware as plain text by name."""
    device, cpuinfo = trainer.strategy.root_device, Path("/proc/cpuinfo")
    name = re.search(r"model name\s*: (.*)", cpuinfo.read_text("utf-8")) if cpuinfo.exists() else None
    processor = name[1] if name else platform.processor() or "unknown"
    return {
        "python": platform.python_version(),
        **{name: version(name) for name in ("sdfhub", "torch", "lightning", "numpy")},
        "system": f"{platform.system()} {platform.machine()}",
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else processor,
        "threads": str(torch.get_num_threads()),
        "processes": str(trainer.world_size),
        "precision": str(trainer.precision),
    }
