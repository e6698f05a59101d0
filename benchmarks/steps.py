"""What training.py times: steps and dense evaluation of ours, and the machine's limits beside them."""

from dataclasses import dataclass

import numpy as np
import torch
from hydra import compose

from sdfhub.composition import instantiate
from sdfhub.data.loading.batches import Loading, ResidentBatches, StepBatches
from sdfhub.model.autodecoder import AutoDecoder
from sdfhub.model.fast.computing import distances
from sdfhub.model.fast.side_by_side import side_by_side
from sdfhub.tasks.train import make_optimisation

STORED = 100_000
"""Samples of each kind in a shape's file; a draw does not depend on what they are."""


@dataclass
class RandomShape:
    """Arrays shaped like a stored shape's."""

    outside: np.ndarray
    inside: np.ndarray
    surface: np.ndarray

    @classmethod
    def drawn(cls, seed: int) -> "RandomShape":
        rng = np.random.default_rng(seed)
        rows = rng.uniform(-1, 1, (2, STORED, 4)).astype(np.float32)
        rows[..., 3] = 0.05 * np.abs(rows[..., 3]) * np.array([[1], [-1]], np.float32)
        normals = rng.normal(size=(STORED // 10, 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return cls(rows[0], rows[1], np.hstack([0.5 * normals, normals]).astype(np.float32))

    def rows(self, name: str) -> int:
        return len(getattr(self, name))

    def read(self, name: str, start: int = 0, count: int | None = None) -> np.ndarray:
        array = getattr(self, name)
        count = len(array) if count is None else count
        if start + count <= len(array):
            return array[start : start + count].copy()
        return np.take(array, np.arange(start, start + count), axis=0, mode="wrap")

    def read_into(self, rows: np.ndarray, name: str, start: int) -> None:
        rows[:] = self.read(name, start, len(rows))


def autodecoder(choice: list[str], rows: int) -> AutoDecoder:
    """The untrained model of a training with these words on its command line."""
    config = compose("config", overrides=choice)
    made = {name: instantiate(config[name], name) for name in ("decoder", "codes", "loss", "computing")}
    return AutoDecoder(**made, optim=make_optimisation(config.optim), shapes=rows)


class OurStep:
    """One step of what a composed config describes, without Lightning's loop around it."""

    def __init__(
        self,
        shapes: list[RandomShape],
        samples: int,
        surface: int,
        choice: list[str],
        bf16: bool,
        device: torch.device,
    ):
        self.model = autodecoder(choice, len(shapes)).to(device)
        self.model.on_fit_start()
        loading = Loading(len(shapes), samples, surface)
        on_cpu = device.type == "cpu"
        self.batches = StepBatches(shapes, loading) if on_cpu else ResidentBatches(shapes, loading, device)
        weights = self.model.decoder.parameters(), self.model.codes.parameters()
        self.optimizer, _ = self.model.optim.configure(*weights, steps=1000)
        self.bf16, self.step = bf16, 0

    def __call__(self) -> None:
        batch = self.batches[self.step]
        self.optimizer.zero_grad()
        with torch.autocast(batch.sdf.device.type, torch.bfloat16, enabled=self.bf16):
            loss, _ = self.model.objective(batch, progress=0.5)
        loss.backward()
        self.optimizer.step()
        self.step += 1

    def operations(self) -> float:
        """Multiplications and additions of the matrix products that a step makes."""
        loading = self.batches.loading
        # forward and two products backward; the written-out gradient is as much again
        points = 3 * (loading.samples_per_shape + 2 * loading.surface_per_shape)
        return operations_per_point(self.model.decoder) * points * self.batches.rows

    def bytes(self) -> float:
        """What products and passes between them read and write, once each; see `bytes_per_point`."""
        loading = self.batches.loading
        signed, surface = bytes_per_point(self.model.decoder, 2 if self.bf16 else 4)
        each = signed * loading.samples_per_shape + surface * loading.surface_per_shape
        return each * self.batches.rows


class OurField:
    """Dense evaluation of a decoder, as meshing calls it."""

    def __init__(self, choice: list[str], points: int, device: torch.device):
        self.model, self.bf16 = autodecoder(choice, 1).eval().to(device), False
        self.points = torch.rand(1, points, 3, device=device) - 0.5

    @torch.no_grad()
    def __call__(self) -> None:
        codes = self.model.codes.table
        distances(self.model.decoder, self.points, codes)

    def operations(self) -> float:
        return operations_per_point(self.model.decoder) * self.points.shape[1]


def operations_per_point(decoder) -> int:
    """Multiplications and additions of a forward pass at one point; a code's share is once per shape."""
    return sum(2 * sum(layer.columns[:2]) * layer.linear.out_features for layer in decoder.layers)


def bytes_per_point(decoder, size: int) -> tuple[int, int]:
    """Fewest bytes of a training step per signed sample, and per surface point with its gradient.

    A hidden layer with I inputs and W outputs, each number of `size` bytes. A signed sample: the product
    reads I and writes W, the pass after it reads W and writes the next I; backward the pass reads I and W and
    writes W, the products read W twice and I, and write I. A surface point has its slopes (W) written too;
    its gradient takes a product (reads W, writes I) and a pass (2 W, W); their backward two products (2 I,
    2 W) and a pass (3 W, 2 W), and the backward of its value reads W more.
    """
    signed = surface = 0
    for layer in decoder.layers[:-1]:
        reads, writes = max(sum(layer.columns[:2]), 1), layer.linear.out_features
        signed += (5 * reads + 6 * writes) * size
        surface += (8 * reads + 19 * writes) * size
    return signed, surface


class Copy:
    """The other limit: a copy of a GiB."""

    def __init__(self, device: torch.device):
        self.a = torch.empty(2**29, dtype=torch.uint8, device=device).random_()
        self.b = torch.empty_like(self.a)

    def __call__(self) -> None:
        self.b.copy_(self.a)

    def bytes(self) -> float:
        return 2 * self.a.numel()


class Product:
    """The limit: matrix products of a layer's size, on a CPU one in each thread, which beats one in all."""

    def __init__(self, width: int, dtype: torch.dtype, rows: int, device: torch.device):
        self.a = torch.randn(rows, width, device=device).to(dtype)
        self.b = torch.randn(width, width, device=device).to(dtype)
        self.count = torch.get_num_threads() if device.type == "cpu" else 1

    def __call__(self) -> None:
        side_by_side(lambda _: torch.mm(self.a, self.b), range(self.count))

    def operations(self) -> float:
        return 2 * self.a.numel() * self.b.shape[1] * self.count
