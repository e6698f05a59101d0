"""Checkpoints of a run: when they are written, and that each is there whole or not at all."""

import logging
import os
import signal
import subprocess
import threading
from pathlib import Path
from typing import Any

import lightning as L
from lightning.pytorch.plugins.io import TorchCheckpointIO

from sdfhub.checkpoint_file import LAST, read_checkpoint, write_checkpoint

log = logging.getLogger(__name__)


class WholeFileIO(TorchCheckpointIO):
    """Writes a checkpoint whole or not at all, also across file systems; reads none that is damaged."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        write_checkpoint(checkpoint, Path(path))

    def load_checkpoint(self, path: Any, map_location: Any = "cpu", weights_only: Any = True) -> dict:
        return read_checkpoint(Path(path), map_location)


class StopOnSignal(L.Callback):
    """Ends a training that is told to stop after the step in hand, and keeps `last.ckpt` wherever one ends.

    SIGTERM, SIGINT and SIGHUP end the process with status 143, 130 and 129, as the shell counts them; a
    second signal ends it at once. SIGUSR1 under SLURM (`sbatch --signal=USR1@120`) also has the job put back
    into the queue. With `accumulate_grad_batches` a step has several batches. `dirpath` has the checkpoints.
    """

    def __init__(self, dirpath: str | Path):
        self.path = Path(dirpath) / LAST
        self._signal: int | None = None
        self._handlers: dict[int, Any] = {}
        self._step = 0

    def on_train_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        self._signal, self._step = None, trainer.global_step
        numbers = [signal.SIGTERM, signal.SIGINT]
        numbers += [signal.SIGHUP] if signal.getsignal(signal.SIGHUP) != signal.SIG_IGN else []  # nohup
        numbers += [signal.SIGUSR1] if "SLURM_JOB_ID" in os.environ else []
        if threading.current_thread() is threading.main_thread():  # else a notebook's or launcher's business
            self._handlers = {number: signal.signal(number, self._receive) for number in numbers}

    def _receive(self, number: int, frame: Any) -> None:
        if self._signal is not None:
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)
        self._signal = number
        log.warning("%s: stopping after this step", signal.Signals(number).name)

    def on_train_batch_end(self, trainer: L.Trainer, module: L.LightningModule, *_: Any) -> None:
        before, self._step = self._step, trainer.global_step
        is_whole = self._step != before  # else the gradient is still accumulated
        if not (is_whole and trainer.strategy.reduce_boolean_decision(self._signal is not None, all=False)):
            return
        self._save(trainer)
        log.warning("stopped after step %d: %s", trainer.global_step, self.path)
        number = self._signal or signal.SIGTERM  # another process of the run received it
        if number == signal.SIGUSR1:
            subprocess.run(["scontrol", "requeue", os.environ["SLURM_JOB_ID"]], check=False)
            number = signal.SIGTERM
        raise SystemExit(128 + number)

    def on_train_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        self._stop_listening()
        self._save(trainer)  # the last epoch need not have been one of every_n_epochs
        if self._signal is not None:
            raise SystemExit(128 + self._signal)

    def on_exception(self, trainer: L.Trainer, module: L.LightningModule, exception: BaseException) -> None:
        self._stop_listening()

    def _save(self, trainer: Any) -> None:
        if not trainer.fast_dev_run:
            trainer.save_checkpoint(self.path)

    def _stop_listening(self) -> None:
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        self._handlers = {}
