"""How far a training is: a bar where somebody watches, lines in a file."""

import logging
import sys
from typing import Any, Literal

import lightning as L
from lightning.pytorch.callbacks import LearningRateMonitor, ProgressBar, RichProgressBar, TQDMProgressBar

log = logging.getLogger(__name__)


class ProgressLines(ProgressBar):
    """A line with the loss at every tenth of a training: in a file a bar is ten thousand lines."""

    def disable(self) -> None:
        """Has no effect: lines are logged by the first process alone."""

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: Any, outputs: Any, *_: Any) -> None:
        step, steps = trainer.global_step, trainer.estimated_stepping_batches  # inf where no end is set
        if trainer.is_global_zero and step * 10 // steps > (step - 1) * 10 // steps:
            epoch, loss = trainer.current_epoch + 1, float(outputs["loss"])
            log.info("step %d of %d, epoch %d: loss %.4g", step, steps, epoch, loss)


def progress(bar: Literal["tqdm", "rich"] = "tqdm") -> ProgressBar:
    """A progress bar if stdout is a terminal, else lines."""
    if not sys.stdout.isatty():
        return ProgressLines()
    return RichProgressBar() if bar == "rich" else TQDMProgressBar()


def fitting_callbacks(callbacks: list[L.Callback], loggers: bool, progress_bar: bool) -> list[L.Callback]:
    """Without the callbacks that Lightning refuses: it has no logger for them, or no progress bar."""
    dropped = (*([] if loggers else [LearningRateMonitor]), *([] if progress_bar else [ProgressBar]))
    return [callback for callback in callbacks if not isinstance(callback, dropped)]
