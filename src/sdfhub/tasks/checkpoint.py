"""Checkpoints of a run: when they are written, and that each is there whole or not at all."""

import os
import uuid
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.plugins.io import TorchCheckpointIO


class WholeFileIO(TorchCheckpointIO):
    """Writes a checkpoint beside its place, syncs it and renames it.

    Lightning's own writer goes through the temporary folder and copies across file systems: a kill at the
    wrong moment leaves half a file where the last good one was.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path, storage_options: Any | None = None) -> None:
        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        beside = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}")
        try:
            with beside.open("wb") as file:
                torch.save(checkpoint, file)
                file.flush()
                os.fsync(file.fileno())
            os.replace(beside, path)
        finally:
            beside.unlink(missing_ok=True)


class Snapshots(ModelCheckpoint):
    """Checkpoints that stay. A class of its own: Lightning tells the states of callbacks apart by class."""


def checkpointing(
    folder: Path, every_n_epochs: int, snapshot_every_n_epochs: int | None
) -> list[ModelCheckpoint]:
    """`last.ckpt`, the newest state, and on demand snapshots `epoch_0500.ckpt` that stay.

    An epoch is a whole number of passes over the shapes, so a run continued from any of them is exact.

    Args:
        folder: where they lie.
        every_n_epochs: how often `last.ckpt` is written, >= 1.
        snapshot_every_n_epochs: how often a snapshot is kept; None keeps none.
    """
    last = ModelCheckpoint(
        folder, filename="last", every_n_epochs=every_n_epochs, enable_version_counter=False
    )
    if snapshot_every_n_epochs is None:
        return [last]
    name = "epoch_{epoch:04d}"
    snapshots = Snapshots(
        folder, name, auto_insert_metric_name=False, save_top_k=-1, every_n_epochs=snapshot_every_n_epochs
    )
    return [last, snapshots]
