"""Prepared shapes as a stream of training batches, with or without loader processes."""

from collections.abc import Callable, Iterator, Sequence

import lightning as L
from torch.utils.data import DataLoader, Sampler

from sdfhub.data.loading.batches import Loading, StepBatches
from sdfhub.data.loading.resident import ResidentBatches
from sdfhub.data.store.store import StoredShape
from sdfhub.errors import SdfhubError


class EpochSteps(Sampler[int]):
    """The step numbers of one epoch that are still to be done: after a resume, a part of them.

    Lightning's own `set_epoch` comes too early after a resume: it starts again at epoch 0.

    Args:
        steps: steps of an epoch.
        done: tells how many steps have been done, also after a resume.
    """

    def __init__(self, steps: int, done: Callable[[], int]):
        self.steps, self.done = steps, done

    def __len__(self) -> int:
        return self.steps

    def __iter__(self) -> Iterator[int]:
        done = self.done()
        return iter(range(done, (done // self.steps + 1) * self.steps))


class SdfDataModule(L.LightningDataModule):
    """Prepared shapes as a training stream.

    Args:
        shapes: prepared training shapes, in the order of the code table.
        loading: how much of them a step and an epoch see.
    """

    def __init__(self, shapes: Sequence[StoredShape], loading: Loading):
        super().__init__()
        if not shapes:
            raise SdfhubError("data: every shape that was to be trained on was rejected, as listed above")
        self.train_shapes = list(shapes)
        self.batches = StepBatches(shapes, loading)
        self.passes_per_epoch, self.workers = loading.passes_per_epoch, loading.workers
        self.resident = loading.resident

    @property
    def rows(self) -> int:
        """Rows that the code table needs: shapes and their augmented copies."""
        return self.batches.rows

    @property
    def steps_per_epoch(self) -> int:
        """Training steps of one epoch."""
        return self.batches.steps_per_pass * self.passes_per_epoch

    def train_dataloader(self) -> DataLoader:
        device = self.trainer.strategy.root_device
        resident = device.type != "cpu" if self.resident is None else self.resident
        if resident and not isinstance(self.batches, ResidentBatches):
            self.batches = ResidentBatches(self.batches.shapes, self.batches.loading, device)
        self.batches.share(self.trainer.global_rank, self.trainer.world_size)
        return DataLoader(
            self.batches,
            sampler=EpochSteps(self.steps_per_epoch, done=lambda: self.trainer.global_step),
            batch_size=None,
            num_workers=0 if resident else self.workers,
            persistent_workers=False,  # a worker of the last epoch would not hear of the next
        )
