"""Seconds, steps and losses of a training, for `metrics.json`."""

import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager

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

    def __init__(self):
        self._first: list[float | Tensor] = []  # tensors until a number is needed: a GPU would be waited for
        self._last: deque[float | Tensor] = deque(maxlen=self.ENDS)
        self._seconds = 0.0  # up to the last start of the clock, in all processes
        self._started: float | None = None
        self._validating = False  # and the clock ran before
        self.stepped = False  # by this process

    def on_train_batch_end(self, trainer: L.Trainer, module: AutoDecoder, outputs, batch, batch_idx) -> None:
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

    def on_validation_start(self, trainer: L.Trainer, module: AutoDecoder) -> None:
        self._validating = self.stop_clock()

    def on_validation_end(self, trainer: L.Trainer, module: AutoDecoder) -> None:
        if self._validating:
            self.start_clock()

    def on_train_end(self, trainer: L.Trainer, module: AutoDecoder) -> None:
        self.stop_clock()

    def _so_far(self) -> float:
        return self._seconds + (time.perf_counter() - self._started if self._started else 0.0)

    def state_dict(self) -> dict:
        ends = {"first": self._first, "last": self._last}
        return {"seconds": self._so_far()} | {end: [float(loss) for loss in ends[end]] for end in ends}

    def load_state_dict(self, state: dict) -> None:
        self._seconds, self._first = float(state["seconds"]), [float(loss) for loss in state["first"]]
        self._last.extend(float(loss) for loss in state["last"])

    def summary(self, model: AutoDecoder) -> dict:
        """Plain numbers: seconds and steps of the whole training, parameters, loss at both ends."""
        state = self.state_dict()
        mean = {"start": np.mean(state["first"]), "end": np.mean(state["last"])} if self._last else {}
        return {
            "seconds": state["seconds"],
            "steps": model.global_step,
            "parameters": sum(parameter.numel() for parameter in model.decoder.parameters()),
            "loss": {key: float(value) for key, value in mean.items()},
        }


@contextmanager
def clock_stopped(trainer: L.Trainer) -> Iterator[None]:
    """The trainer's `TrainingRecord`, if it has one, counts no seconds within; for callbacks that draw."""
    records = [callback for callback in trainer.callbacks if isinstance(callback, TrainingRecord)]
    was_running = [record for record in records if record.stop_clock()]
    try:
        yield
    finally:
        for record in was_running:
            record.start_clock()
