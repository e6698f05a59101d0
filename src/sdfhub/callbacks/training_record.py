"""Seconds, steps and losses of a training, for `metrics.json`."""

import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import lightning as L
import numpy as np
from torch import Tensor

from sdfhub.model.autodecoder import AutoDecoder


class TrainingRecord(L.Callback):
    """Seconds, steps and the loss at both ends of a training.

    The clock starts after the first step of a process, in which loops are compiled. It stands still during
    validation and in `clock_stopped`. What an interrupted training had gathered by its last checkpoint counts
    when the training is continued.
    """

    ENDS = 20
    """Steps averaged at either end."""

    def __init__(self) -> None:
        self._first: list[float | Tensor] = []  # tensors until a number is needed: a GPU would be waited for
        self._last: deque[float | Tensor] = deque(maxlen=self.ENDS)
        self._seconds = 0.0  # up to the last start of the clock, in all processes
        self._started: float | None = None
        self.stepped = False  # by this process

    def on_train_batch_end(self, trainer: L.Trainer, module: Any, outputs: Any, *_: Any) -> None:
        if not self.stepped:
            self.stepped = True
            self.start_clock()
        self._last.append(outputs["loss"])
        if len(self._first) < self.ENDS:
            self._first.append(outputs["loss"])

    def start_clock(self) -> None:
        """Counts seconds from now on."""
        self._started = time.perf_counter()

    def stop_clock(self) -> bool:
        """Counts no seconds from now on; returns whether it did before."""
        was_running = self._started is not None
        self._seconds, self._started = self._so_far(), None
        return was_running

    def on_validation_start(self, trainer: L.Trainer, module: Any) -> None:
        self.stop_clock()

    def on_validation_end(self, trainer: L.Trainer, module: Any) -> None:
        if self.stepped:
            self.start_clock()

    def on_train_end(self, trainer: L.Trainer, module: Any) -> None:
        self.stop_clock()

    def _so_far(self) -> float:
        return self._seconds + (time.perf_counter() - self._started if self._started else 0.0)

    def state_dict(self) -> dict[str, Any]:
        return {
            "seconds": self._so_far(),
            "first": [float(loss) for loss in self._first],
            "last": [float(loss) for loss in self._last],
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._seconds, self._first = state["seconds"], list(state["first"])
        self._last.extend(state["last"])

    def summary(self, model: AutoDecoder) -> dict[str, Any]:
        """Plain numbers: seconds and steps of the whole training, parameters, loss at both ends."""
        state = self.state_dict()
        ends = {"start": state["first"], "end": state["last"]}
        return {
            "seconds": state["seconds"],
            "steps": model.global_step,
            "parameters": sum(parameter.numel() for parameter in model.decoder.parameters()),
            "loss": {end: float(np.mean(losses)) for end, losses in ends.items() if losses},
        }


@contextmanager
def clock_stopped(trainer: L.Trainer) -> Iterator[None]:
    """The trainer's `TrainingRecord`, if it has one, counts no seconds within; for callbacks that draw."""
    callbacks: list[L.Callback] = trainer.callbacks  # type: ignore[attr-defined]
    records = [callback for callback in callbacks if isinstance(callback, TrainingRecord)]
    was_running = [record for record in records if record.stop_clock()]
    yield
    for record in was_running:
        record.start_clock()
