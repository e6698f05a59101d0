"""Training steps side by side with DeepSDF's: samples a second, and the share of the GEMM limit.

    python benchmarks/training.py [--shapes 4] [--samples 4096] [--rounds 5] [--threads N] [overrides]

Every round times one step of each rival, one after the other, so that a machine's moods hit all alike;
printed are medians over the rounds. DeepSDF's step is re-implemented here from its description: its network
(weight norm, dropout 0.2, the code concatenated to every point), its sum of clamped L1 over the batch, its
prior |z|, Adam, and its data path, one npz file a shape read anew at every step. Steps of ours include the
draw of their samples from the store. Only samples with a signed distance are counted: what normals cost is
on our account.
"""

import argparse
import statistics
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from hydra import compose, initialize_config_dir
from torch import nn
from torch.nn.utils.parametrizations import weight_norm

from sdfhub.data.batches import Augmentation, Loading, StepBatches
from sdfhub.tasks.app import register_resolvers
from sdfhub.tasks.build import plain
from sdfhub.tasks.run import build_autodecoder

CONF = Path(__file__).resolve().parents[1] / "conf"
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

    def read(self, name: str, start: int, count: int) -> np.ndarray:
        array = getattr(self, name)
        if start + count <= len(array):
            return array[start : start + count].copy()
        return np.take(array, np.arange(start, start + count), axis=0, mode="wrap")


class ReferenceDecoder(nn.Module):
    """DeepSDF's network: 8 hidden layers of 512, input re-injected at the fourth, the code at every point."""

    def __init__(self, code_size: int = 256, width: int = 512, depth: int = 8, again: int = 4):
        super().__init__()
        given = code_size + 3
        sizes = [given] + [width] * depth
        layers = []
        for index in range(depth):
            emitted = width - given if index + 1 == again else width
            layers.append(weight_norm(nn.Linear(sizes[index], emitted)))
        self.layers, self.again = nn.ModuleList(layers), again
        self.head = nn.Linear(width, 1)

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        """Signed distances [P, 1] of inputs [P, L + 3]."""
        x = inputs
        for index, layer in enumerate(self.layers):
            if index == self.again:
                x = torch.cat([x, inputs], dim=1)
            x = F.dropout(F.relu(layer(x)), 0.2, self.training)
        return torch.tanh(self.head(x))


class ReferenceStep:
    """One step of DeepSDF's published training."""

    def __init__(self, files: list[Path], samples: int):
        self.files, self.samples = files, samples
        self.decoder = ReferenceDecoder()
        self.codes = nn.Embedding(len(files), 256, max_norm=1.0)
        nn.init.normal_(self.codes.weight, 0, 1 / 16)
        groups = [
            {"params": self.decoder.parameters(), "lr": 5e-4},
            {"params": self.codes.parameters(), "lr": 1e-3},
        ]
        self.optimizer = torch.optim.Adam(groups)

    def _load(self, file: Path) -> torch.Tensor:
        """[N, 4] samples of one shape: half outside, half inside, without rows that are not numbers."""
        drawn = []
        with np.load(file) as arrays:
            for name in ("pos", "neg"):
                rows = torch.from_numpy(arrays[name])
                rows = rows[~rows[:, 3].isnan()]
                drawn.append(rows[(torch.rand(self.samples // 2) * len(rows)).long()])
        return torch.cat(drawn)

    def __call__(self) -> None:
        rows = torch.stack([self._load(file) for file in self.files]).reshape(-1, 4)
        which = torch.arange(len(self.files)).repeat_interleave(self.samples)
        target = rows[:, 3:].clamp(-0.1, 0.1)
        self.optimizer.zero_grad()
        codes = self.codes(which)
        predicted = self.decoder(torch.cat([codes, rows[:, :3]], dim=1)).clamp(-0.1, 0.1)
        loss = F.l1_loss(predicted, target, reduction="sum") / len(rows)
        loss = loss + 1e-4 * codes.norm(dim=1).sum() / len(rows)
        loss.backward()
        self.optimizer.step()


class OurStep:
    """One step of what a composed config describes, without Lightning's loop around it."""

    def __init__(self, shapes: list[RandomShape], samples: int, surface: int, choice: list[str], bf16: bool):
        config = plain(compose("config", overrides=choice))
        self.model = build_autodecoder(config, rows=len(shapes), steps=1000)
        self.batches = StepBatches(shapes, Loading(len(shapes), samples, surface, 1, 0, Augmentation(), 0))
        configured = self.model.configure_optimizers()
        self.optimizer, self.bf16, self.step = configured["optimizer"], bf16, 0

    def __call__(self) -> None:
        batch = self.batches[self.step]
        self.optimizer.zero_grad()
        with torch.autocast("cpu", torch.bfloat16, enabled=self.bf16):
            loss, _ = self.model.objective(batch, progress=0.5, epoch=10)
        loss.backward()
        self.optimizer.step()
        self.step += 1

    def operations(self, samples: int, surface: int) -> float:
        """Multiplications and additions of matrix products in a step, for each shape."""
        per_point = 0
        for layer in self.model.decoder.layers:
            per_point += 2 * sum(layer.columns[:2]) * layer.linear.out_features
        # forward and two products backward; the written-out gradient is as much again
        return 3 * per_point * (samples + 2 * surface)


def gemm_rate(width: int, rows: int, dtype: torch.dtype = torch.float32, repeats: int = 7) -> float:
    """Operations a second of the product [rows, width] x [width, width], the best of a few."""
    a, b = torch.randn(rows, width, dtype=dtype), torch.randn(width, width, dtype=dtype)
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        a @ b
        seconds.append(time.perf_counter() - start)
    return 2 * rows * width * width / min(seconds)


def rivals(args: argparse.Namespace, folder: Path) -> dict[str, object]:
    """The steps to compare, by name."""
    shapes = [RandomShape.drawn(seed) for seed in range(args.shapes)]
    files = [folder / f"{index}.npz" for index in range(args.shapes)]
    for file, shape in zip(files, shapes, strict=True):
        np.savez(file, pos=shape.outside, neg=shape.inside)
    paper = ["decoder=paper_585k", "encoding=fourier", "encoding.frequencies=12", *args.overrides]
    deepsdf = ["experiment=deepsdf", *args.overrides]
    surface = args.samples // 4  # as at scale=paper
    made: dict[str, object] = {"DeepSDF, reference": ReferenceStep(files, args.samples)}
    for bf16 in (False, True):
        suffix = ", bf16" if bf16 else ""
        made |= {
            "decoder=deepsdf" + suffix: OurStep(shapes, args.samples, 0, deepsdf, bf16),
            "paper_585k, HOSC, normals=off" + suffix: OurStep(
                shapes, args.samples, 0, ["normals=off", *paper], bf16
            ),
            "paper_585k, HOSC, normals=on" + suffix: OurStep(shapes, args.samples, surface, paper, bf16),
            "paper_585k, SIREN, normals=on" + suffix: OurStep(
                shapes, args.samples, surface, ["activation=siren", *paper], bf16
            ),
        }
    return made


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--shapes", type=int, default=4)
    parser.add_argument("--samples", type=int, default=4096)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--threads", type=int, help="default: what torch takes")
    parser.add_argument("overrides", nargs="*")
    args = parser.parse_args()
    if args.threads:
        torch.set_num_threads(args.threads)
    register_resolvers()
    torch.manual_seed(0)
    with (
        tempfile.TemporaryDirectory() as folder,
        initialize_config_dir(str(CONF), version_base=None),
    ):
        steps = rivals(args, Path(folder))
        seconds = {name: [] for name in steps}
        for round_ in range(args.rounds + 1):  # the first warms up
            for name, step in steps.items():
                start = time.perf_counter()
                step()
                if round_:
                    seconds[name].append(time.perf_counter() - start)
    report(args, steps, {name: statistics.median(times) for name, times in seconds.items()})


def report(args: argparse.Namespace, steps: dict[str, object], seconds: dict[str, float]) -> None:
    """Prints a Markdown table."""
    rows = args.shapes * args.samples
    rate = {dtype: gemm_rate(512, rows, dtype) for dtype in (torch.float32, torch.bfloat16)}
    print(f"{torch.get_num_threads()} threads, {args.shapes} shapes x {args.samples} samples a step")
    rates = ", ".join(f"{str(dtype)[6:]} {value / 1e9:.0f}" for dtype, value in rate.items())
    print(f"GEMM 512 wide, G operations a second: {rates}")
    print("\n| step | samples/s | times DeepSDF | share of the GEMM rate |\n| --- | --- | --- | --- |")
    reference = seconds["DeepSDF, reference"]
    for name, taken in seconds.items():
        step, share = steps[name], ""
        if isinstance(step, OurStep):
            operations = args.shapes * step.operations(args.samples, step.batches.loading.surface_per_shape)
            limit = rate[torch.bfloat16 if step.bf16 else torch.float32]
            share = f"{operations / taken / limit:.2f}"
        print(f"| {name} | {rows / taken:,.0f} | {reference / taken:.2f} | {share} |")


if __name__ == "__main__":
    sys.exit(main())
