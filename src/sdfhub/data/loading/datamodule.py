"""The shapes of a source as a LightningDataModule: prepared, split, and streamed as training batches."""

import logging
from collections.abc import Callable, Iterator
from functools import cached_property
from pathlib import Path
from typing import Literal, NamedTuple

import lightning as L
import torch
from pydantic import NonNegativeInt, PositiveInt
from torch.utils.data import DataLoader, Sampler

from sdfhub.data.loading.batches import Loading, ResidentBatches, StepBatches
from sdfhub.data.preparation.settings import DEFAULT, Preparation
from sdfhub.data.sources.source import Source
from sdfhub.data.splits import Split, split
from sdfhub.data.store import store as stores
from sdfhub.data.store.stored_shape import StoredShape
from sdfhub.errors import SdfhubError

log = logging.getLogger(__name__)


class ValidationShape(NamedTuple):
    """One shape to be scored while training: its role, its row of the code table where it has one, itself."""

    role: Literal["train", "held_out"]
    row: int | None
    shape: StoredShape


class EpochSteps(Sampler[int]):
    """The step numbers of one epoch, from the first that has not been done.

    Lightning ends an epoch by itself, also one that a checkpoint of its middle resumes. Its own `set_epoch`
    comes too early after a resume. `done` gives the steps done so far, also then; None counts them here.
    """

    def __init__(self, steps: int, done: Callable[[], int] | None = None):
        self.steps, self.done, self.counted = steps, done, 0

    def __len__(self) -> int:
        return self.steps

    def __iter__(self) -> Iterator[int]:
        first = self.counted if self.done is None else self.done()
        self.counted += self.steps
        return iter(range(first, first + self.steps))


class SdfDataModule(L.LightningDataModule):
    """Shapes of a source as training batches, a part of them held out; works with or without a trainer.

    Batches derive from (seed, step): a resumed training sees what an undisturbed one would. In a
    distributed training give the trainer `use_distributed_sampler=False`; each batch is shared here.

    Attributes:
        train_shapes, held_out_shapes: prepared, in the order of the code table, after `setup`.
    """

    def __init__(
        self,
        source: Source,
        store: str = "data/store",  # folder of prepared samples, shared by all runs
        workers: PositiveInt | None = None,  # processes that prepare shapes; None: one per core
        shapes: PositiveInt | None = None,  # to train on; None: all not held out; of a folder at most so many
        held_out: NonNegativeInt = 4,  # never trained on; see `splits.split`
        split_seed: NonNegativeInt = 0,  # draws both
        preparation: Preparation = DEFAULT,
        loader: Loading = Loading(),  # noqa: B008 - frozen
        validation_shapes: NonNegativeInt = 2,  # of each role, in `val_dataloader`
    ):
        super().__init__()
        self.source, self.store, self.workers = source, store, workers
        self.shapes, self.held_out, self.split_seed = shapes, held_out, split_seed
        self.preparation, self.loader, self.validation_shapes = preparation, loader, validation_shapes
        self.train_shapes: list[StoredShape] = []
        self.held_out_shapes: list[StoredShape] = []

    @cached_property
    def split(self) -> Split:
        """The source's shapes by role; none is prepared for it."""
        offered = self.source.shapes()
        roles = split(offered, self.shapes, self.held_out, self.split_seed, self.source.is_collection)
        there, (train, held_out) = len(offered), map(len, roles)
        left_out = there - train - held_out
        if self.source.is_collection and (left_out or (train, held_out) != (self.shapes, self.held_out)):
            counts = f"of {there} shapes {train} are trained on, {held_out} held out, {left_out} left out"
            wanted = f"data.shapes={self.shapes or 'null'} and data.held_out={self.held_out}"
            log.info(f"data: {self.source.name}: {counts} ({wanted} are upper bounds)")
        return roles

    def prepared(self, roles: Split) -> tuple[list[StoredShape], list[StoredShape]]:
        """The stored shapes of both roles; missing ones are prepared, rejected ones left out."""
        store = self.filled(roles)
        train, held_out = ([store[s.id] for s in part if s.id in store] for part in roles)
        log.info(f"data: {self.source.name}: {len(train)} shapes to train on, {len(held_out)} held out")
        log.info(f"store: {store.folder}: {store.summary()}")
        return train, held_out

    def filled(self, roles: Split) -> stores.Store:
        """The store with the shapes of both roles."""
        shapes = roles.train + roles.held_out
        return stores.prepare(self.source, shapes, self.preparation, Path(self.store), self.workers)

    def prepare_part(self, part: int, parts: int) -> tuple[int, int]:
        """Prepares part 1 <= `part` <= `parts` of the shapes; returns its shapes, and those prepared now."""
        own = (self.split.train + self.split.held_out)[part - 1 :: parts]
        made = stores.prepare_part(self.source, own, self.preparation, Path(self.store), self.workers)
        return len(own), made

    def prepare_data(self) -> None:
        """Fills the store; a second call does nothing."""
        self.setup()

    def setup(self, stage: str | None = None) -> None:
        """Opens the store, filled as `prepare_data` does; a second call does nothing."""
        if self.train_shapes:
            return
        if self.loader.surface_per_shape and not self.source.has_normals:
            what = f"the files of data={self.source.name} carry none; train with normals=off"
            raise SdfhubError(f"normals=on: {what}")
        self.train_shapes, self.held_out_shapes = self.prepared(self.split)

    @cached_property
    def batches(self) -> StepBatches:
        """Training batches by step, after `setup`."""
        if not self.train_shapes:
            raise SdfhubError(
                "data: no shapes: call prepare_data() and setup() first, or see why all were rejected"
            )
        return StepBatches(self.train_shapes, self.loader)

    @property
    def rows(self) -> int:
        """Rows that the code table needs: shapes and their augmented copies."""
        return self.batches.rows

    def train_dataloader(self) -> DataLoader:
        trainer = self.trainer
        device = trainer.strategy.root_device if trainer else torch.device("cpu")
        resident = device.type != "cpu" if self.loader.resident is None else self.loader.resident
        if resident and not isinstance(self.batches, ResidentBatches):
            self.batches = ResidentBatches(self.train_shapes, self.loader, device)
        done = None
        if trainer:
            self.batches.share(trainer.global_rank, trainer.world_size)
            done = lambda: trainer.global_step * trainer.accumulate_grad_batches  # noqa: E731
        steps, workers = EpochSteps(len(self.batches), done), 0 if resident else self.loader.workers
        # workers do not persist: one of the last epoch would not hear of the next
        return DataLoader(self.batches, sampler=steps, batch_size=None, num_workers=workers)

    def val_dataloader(self) -> DataLoader:
        """Yields a few `ValidationShape`, held-out ones first."""
        count = self.validation_shapes
        items = [ValidationShape("held_out", None, shape) for shape in self.held_out_shapes[:count]]
        items += [ValidationShape("train", row, s) for row, s in enumerate(self.train_shapes[:count])]
        return DataLoader(items, batch_size=None)  # type: ignore[arg-type]
