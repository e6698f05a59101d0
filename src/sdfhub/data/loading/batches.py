"""Streams per-shape samples as training batches: step number in, batch out, nothing remembered.

A batch is a function of (seed, step), so that a resumed run sees what an uninterrupted one would, with any
number of loader workers. Stored rows are shuffled, so a random draw is one contiguous, wrapping slice.
"""

from collections.abc import Sequence
from typing import Annotated

import numpy as np
import torch
from pydantic import Field, NonNegativeInt, PositiveInt
from pydantic.dataclasses import dataclass
from torch.utils.data import Dataset

from sdfhub.data.store.stored_shape import StoredShape
from sdfhub.errors import SdfhubError
from sdfhub.shapes import Batch


@dataclass(frozen=True)
class Augmentation:
    """Extra training shapes: seeded similar copies of the real ones, each with a code of its own.

    The paper names data augmentation and does not describe it. Reflection and uniform scaling are the
    transforms under which a signed distance stays exact (d becomes scale * d).
    """

    copies: NonNegativeInt = 0  # of each shape
    mirror: bool = True  # odd copies in the plane x = 0
    smallest: Annotated[float, Field(gt=0, le=1)] = 0.8  # scales are uniform from here to 1

    def transform(self, copy: int, row: int, seed: int) -> tuple[np.ndarray, np.float32]:
        """Factors [3] of the axes and the scale of distances, for copy 0 (the shape itself) and up."""
        if copy == 0:
            return np.ones(3, np.float32), np.float32(1)
        scale = np.float32(np.random.default_rng((seed, row)).uniform(self.smallest, 1))
        flip = -1 if self.mirror and copy % 2 else 1
        return np.array([flip, 1, 1], np.float32) * scale, scale


@dataclass(frozen=True)
class Loading:
    """How much of which shapes a training step sees."""

    shapes_per_step: PositiveInt = 20  # B
    samples_per_shape: Annotated[int, Field(ge=2)] = 512  # N, half outside, half inside
    surface_per_shape: NonNegativeInt = 0  # M oriented surface points a step and shape; 0 without normals
    passes_per_epoch: PositiveInt = 1  # visits to every shape: few shapes make epochs too short otherwise
    workers: NonNegativeInt = 0  # loader processes; 0 draws in the training process
    augmentation: Augmentation = Augmentation()
    seed: NonNegativeInt = 0  # of every draw
    resident: bool | None = None  # all samples in the memory of the device; None: where that is a GPU


class StepBatches(Dataset):
    """Training batches by step number.

    Args:
        shapes: S prepared shapes; shape s has code row s, its copy c row s + c * S.
        loading: what a step draws; never more shapes a step than there are rows.
    """

    def __init__(self, shapes: Sequence[StoredShape], loading: Loading):
        self.shapes, self.loading = shapes, loading
        self.rows = len(shapes) * (1 + loading.augmentation.copies)
        self.shapes_per_step = min(loading.shapes_per_step, self.rows)
        self.steps_per_pass = self.rows // self.shapes_per_step
        self.rank, self.world = 0, 1

    def share(self, rank: int, world: int) -> None:
        """Keeps, of every batch, the part of process `rank` of `world`."""
        if self.shapes_per_step % world:
            raise SdfhubError(
                f"data.loader.shapes_per_step={self.shapes_per_step} cannot be shared by {world} processes; "
                f"choose a multiple of {world}, at most {self.rows}"
            )
        self.rank, self.world = rank, world

    def __len__(self) -> int:
        """Steps of an epoch; later ones are there, too."""
        return self.steps_per_pass * self.loading.passes_per_epoch

    def __getitem__(self, step: int) -> Batch:
        rows, loading = self.rows_of(step), self.loading
        samples = np.empty((len(rows), loading.samples_per_shape, 4), np.float32)
        surface = np.empty((len(rows), loading.surface_per_shape, 6), np.float32)
        for row, points, oriented in zip(rows, samples, surface, strict=True):
            copy, index = divmod(int(row), len(self.shapes))
            rng = self.generator(step, row)
            draw_signed(points, self.shapes[index], rng)
            draw_rows(oriented, self.shapes[index], "surface", rng)
            if copy:
                axes, scale = loading.augmentation.transform(copy, int(row), loading.seed)
                points *= np.append(axes, scale)
                oriented *= np.concatenate([axes, np.sign(axes)])
        return batch_of(*map(torch.from_numpy, (rows, samples, surface)))

    def rows_of(self, step: int) -> np.ndarray:
        """[B] int64 rows of the code table that a step sees, of them this process's share."""
        # every pass shuffles anew; rows beyond the last whole step wait for another pass's order
        rng = np.random.default_rng((self.loading.seed, 1, step // self.steps_per_pass))
        start = step % self.steps_per_pass * self.shapes_per_step
        rows = rng.permutation(self.rows)[start : start + self.shapes_per_step]
        return rows[self.rank :: self.world]

    def generator(self, step: int, row: int) -> np.random.Generator:
        """What draws the samples of one row at one step."""
        return np.random.default_rng((self.loading.seed, 2, step, row))


def batch_of(rows: torch.Tensor, samples: torch.Tensor, surface: torch.Tensor) -> Batch:
    """A batch from its rows [B], samples [B, N, 4] and oriented surface points [B, M, 6]."""
    return Batch(rows, samples[..., :3], samples[..., 3], surface[..., :3], surface[..., 3:])


def signed_samples(shape: StoredShape, count: int, rng: np.random.Generator) -> np.ndarray:
    """[count, 4] points and signed distances of a shape, half outside, half inside (the odd one outside)."""
    rows = np.empty((count, 4), np.float32)
    draw_signed(rows, shape, rng)
    return rows


def draw_signed(rows: np.ndarray, shape: StoredShape, rng: np.random.Generator) -> None:
    """Fills rows [N, 4], contiguous, with what `signed_samples` returns."""
    outside = len(rows) - len(rows) // 2
    draw_rows(rows[:outside], shape, "outside", rng)
    draw_rows(rows[outside:], shape, "inside", rng)


def draw_rows(rows: np.ndarray, shape: StoredShape, name: str, rng: np.random.Generator) -> None:
    """Fills rows [n, C], contiguous, with consecutive ones of a shuffled array from a random start."""
    refuse_empty(shape, name, len(rows))
    if len(rows):
        shape.read_into(rows, name, int(rng.integers(shape.rows(name))))


def refuse_empty(shape: StoredShape, name: str, count: int) -> None:
    """Raises SdfhubError where rows are to be drawn of an array that has none."""
    if count and not shape.rows(name):
        raise SdfhubError(f"{shape.id}: holds no {name} samples; see data.preparation, or normals=off")
