"""Per-shape samples as training batches: step number in, batch out, nothing remembered.

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

from sdfhub.data.store.stored_shape import COLUMNS, StoredShape, draw_rows, refuse_empty, signed_samples
from sdfhub.errors import SdfhubError
from sdfhub.shapes import Batch

# Largest number of each array: samples lie near the cube, surface points and normals in the unit ball.
# Distances beyond it are cut, far outside of what the clamped loss tells apart.
EXTENT = {"outside": 1.5, "inside": 1.5, "surface": 1.0}


@dataclass(frozen=True)
class Augmentation:
    """Extra training shapes: seeded similar copies of the real ones, each with a code of its own.

    The paper names data augmentation and does not describe it. Reflection and uniform scaling are the
    transforms under which a signed distance stays exact (d becomes scale * d).
    """

    copies: NonNegativeInt = 0  # of each shape
    mirror: bool = True  # odd copies in the plane x = 0
    smallest: Annotated[float, Field(gt=0, le=1)] = 0.8  # scales are uniform from here to 1

    def factors(self, copy: int, row: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
        """Of samples [4] (x, y, z, sdf) and of oriented points [6], for copy 0 (the shape itself) and up."""
        scale = np.float32(np.random.default_rng((seed, row)).uniform(self.smallest, 1) if copy else 1)
        axes = np.array([-1 if self.mirror and copy % 2 else 1, 1, 1], np.float32) * scale
        return np.append(axes, scale), np.append(axes, np.sign(axes))


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
    """Training batches of S shapes by step number; shape s has code row s, its copy c row s + c * S."""

    def __init__(self, shapes: Sequence[StoredShape], loading: Loading):
        self.shapes, self.loading = shapes, loading
        self.rows = len(shapes) * (1 + loading.augmentation.copies)
        self.shapes_per_step = min(loading.shapes_per_step, self.rows)
        self.steps_per_pass = self.rows // self.shapes_per_step
        self.rank, self.world = 0, 1

    def share(self, rank: int, world: int) -> None:
        """Keeps, of every batch, the part of process `rank` of `world`."""
        if self.shapes_per_step % world:
            setting = f"data.loader.shapes_per_step={self.shapes_per_step}"
            advice = f"choose a multiple of {world}, at most {self.rows}"
            raise SdfhubError(f"{setting} cannot be shared by {world} processes; {advice}")
        self.rank, self.world = rank, world

    def __len__(self) -> int:
        """Steps of an epoch; later ones are there, too."""
        return self.steps_per_pass * self.loading.passes_per_epoch

    def __getitem__(self, step: int) -> Batch:
        rows, loading = self.rows_of(step), self.loading
        samples = np.empty((len(rows), loading.samples_per_shape, 4), np.float32)
        surface = np.empty((len(rows), loading.surface_per_shape, 6), np.float32)
        for row, points, oriented in zip(rows, samples, surface, strict=True):
            shape, rng = self.shapes[row % len(self.shapes)], self.generator(step, row)
            signed_samples(shape, len(points), rng, points)
            draw_rows(oriented, shape, "surface", rng)
        return self.batch_of(rows, torch.from_numpy(samples), torch.from_numpy(surface))

    def batch_of(self, rows: np.ndarray, samples: torch.Tensor, surface: torch.Tensor) -> Batch:
        """The batch of rows [B], from samples [B, N, 4] and oriented points [B, M, 6] of their shapes."""
        if (augmentation := self.loading.augmentation).copies:
            copies = zip((rows // len(self.shapes)).tolist(), rows.tolist(), strict=True)
            factors = [augmentation.factors(copy, row, self.loading.seed) for copy, row in copies]
            of_samples, of_surface = (np.stack(part)[:, None] for part in zip(*factors, strict=True))
            samples *= torch.from_numpy(of_samples).to(samples.device)
            surface *= torch.from_numpy(of_surface).to(surface.device)
        here = torch.from_numpy(rows).to(samples.device)
        return Batch(here, samples[..., :3], samples[..., 3], surface[..., :3], surface[..., 3:])

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


class ResidentBatches(StepBatches):
    """The same batches from samples that all lie on one device: a step copies nothing but where it starts.

    Numbers are kept as 16-bit fractions of EXTENT: half the memory, and with an error of 2e-5 ten times
    closer than 16-bit floats. A thousand shapes of 500,000 samples take 4.4 GB. Plain twin: `StepBatches`.
    """

    def __init__(self, shapes: Sequence[StoredShape], loading: Loading, device: torch.device):
        super().__init__(shapes, loading)
        self.device, inside = device, loading.samples_per_shape // 2
        outside = loading.samples_per_shape - inside
        self.wanted = {"outside": outside, "inside": inside, "surface": loading.surface_per_shape}
        self.counts = {name: np.array([shape.rows(name) for shape in shapes]) for name in EXTENT}
        self.first = {name: np.cumsum([0, *counts]) for name, counts in self.counts.items()}
        self.tables = {name: self._table(name) for name in EXTENT}

    def _table(self, name: str) -> torch.Tensor:
        """[R, C] int16, the rows of all shapes, one after the other."""
        first = self.first[name]
        table = torch.empty((int(first[-1]), COLUMNS[name]), dtype=torch.int16, device=self.device)
        for index, shape in enumerate(self.shapes):
            refuse_empty(shape, name, self.wanted[name])
            array = torch.from_numpy(shape.read(name))
            if len(array) and (reach := array[:, :3].abs().max()) > EXTENT[name]:
                raise SdfhubError(f"{shape.id}: reaches {reach:.3g}; train with data.loader.resident=false")
            fractions = (array / EXTENT[name]).clamp(-1, 1).mul(32767).round().to(torch.int16)
            table[first[index] : first[index + 1]] = fractions.to(self.device)
        return table

    def __getitem__(self, step: int) -> Batch:
        rows = self.rows_of(step)
        shapes, starts = rows % len(self.shapes), np.zeros((3, len(rows)), np.int64)
        for column, (row, shape) in enumerate(zip(rows, shapes, strict=True)):
            rng = self.generator(step, row)
            for line, name in enumerate(EXTENT):
                starts[line, column] = rng.integers(self.counts[name][shape]) if self.wanted[name] else 0
        outside, inside, surface = map(self._gathered, EXTENT, [shapes] * 3, starts)
        return self.batch_of(rows, torch.cat([outside, inside], dim=1), surface)

    def _gathered(self, name: str, shapes: np.ndarray, start: np.ndarray) -> torch.Tensor:
        """[B, n, C] consecutive rows, wrapping within each shape, as float32."""
        places = self.first[name][shapes], self.counts[name][shapes], start
        first, rows, begin = (torch.from_numpy(array).to(self.device) for array in places)
        steps = begin[:, None] + torch.arange(self.wanted[name], device=self.device)
        return self.tables[name][first[:, None] + steps % rows[:, None].clamp(min=1)] * (EXTENT[name] / 32767)
