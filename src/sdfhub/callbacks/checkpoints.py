"""Checkpoints of a run: when they are written, and that each is there whole or not at all."""

import os
import signal
import subprocess
import threading
from pathlib import Path
from typing import Any

import lightning as L
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.plugins.io import TorchCheckpointIO

from sdfhub.checkpoint_file import LAST, read_checkpoint, write_checkpoint


class WholeFileIO(TorchCheckpointIO):
    """Writes a checkpoint whole or not at all; reads none that is damaged.

    Lightning's own writer goes through the temporary folder and copies across file systems: a kill at the
    wrong moment leaves half a file where the last good one was.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path, storage_options: Any | None = None) -> None:
        write_checkpoint(checkpoint, Path(path))

    def load_checkpoint(self, path, map_location: Any = "cpu", weights_only: bool | None = True) -> dict:
        return read_checkpoint(Path(path), map_location)


class Snapshots(ModelCheckpoint):
    """Checkpoints that stay, named after the epochs done: Lightning counts them from 0.

    A class of its own, since Lightning tells the states of callbacks apart by class.
    """

    def format_checkpoint_name(self, metrics: dict[str, Any], *args: Any, **kwargs: Any) -> str:
        return super().format_checkpoint_name(metrics | {"epoch": metrics["epoch"] + 1}, *args, **kwargs)


class KeepLast(L.Callback):
    """`last.ckpt` where a training ends: by itself, or told to by a signal, after the step in hand.

    SIGTERM and SIGINT end the process with status 143 and 130, as the shell counts them; a second one ends
    it at once. SIGUSR1 under SLURM (`sbatch --signal=USR1@120`) also has the job put back into the queue.

    Args:
        folder: of the checkpoints.
    """

    def __init__(self, folder: Path):
        self.path = folder / LAST
        self._told: int | None = None
        self._before: dict[int, Any] = {}

    def on_train_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        self._told = None
        listened = [signal.SIGTERM, signal.SIGINT]
        if "SLURM_JOB_ID" in os.environ:
            listened.append(signal.SIGUSR1)
        if threading.current_thread() is threading.main_thread():  # else a notebook's or launcher's business
            self._before = {number: signal.signal(number, self._tell) for number in listened}

    def _tell(self, number: int, frame: Any) -> None:
        if self._told is not None:
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)
        self._told = number
        print(f"{signal.Signals(number).name}: stopping after this step", flush=True)

    def on_train_batch_end(self, trainer: L.Trainer, module: L.LightningModule, *_: Any) -> None:
        if not trainer.strategy.reduce_boolean_decision(self._told is not None, all=False):
            return
        trainer.save_checkpoint(self.path)
        print(f"stopped after step {trainer.global_step}: {self.path}", flush=True)
        number = self._told or signal.SIGTERM  # another process of the run was told
        if number == signal.SIGUSR1:
            subprocess.run(["scontrol", "requeue", os.environ["SLURM_JOB_ID"]], check=False)
            number = signal.SIGTERM
        raise SystemExit(128 + number)

    def on_train_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        self._stop_listening()
        trainer.save_checkpoint(self.path)  # the last epoch need not have been one of every_n_epochs
        if self._told is not None:
            raise SystemExit(128 + self._told)

    def on_exception(self, trainer: L.Trainer, module: L.LightningModule, exception: BaseException) -> None:
        self._stop_listening()

    def _stop_listening(self) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before = {}


def checkpointing(folder: Path, every_n_epochs: int, snapshot_every_n_epochs: int | None) -> list[L.Callback]:
    """`last.ckpt`, the newest state, and on demand snapshots `epoch_0500.ckpt` that stay.

    A run continued from any of them is exact; on a GPU up to rounding, where its kernels add in any order.

    Args:
        folder: where they lie.
        every_n_epochs: how often `last.ckpt` is written, >= 1.
        snapshot_every_n_epochs: how often a snapshot is kept; None keeps none.
    """
    last = ModelCheckpoint(
        folder, filename="last", every_n_epochs=every_n_epochs, enable_version_counter=False
    )
    if snapshot_every_n_epochs is None:
        return [KeepLast(folder), last]
    name = "epoch_{epoch:04d}"
    snapshots = Snapshots(
        folder, name, auto_insert_metric_name=False, save_top_k=-1, every_n_epochs=snapshot_every_n_epochs
    )
    return [KeepLast(folder), last, snapshots]
