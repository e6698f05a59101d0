"""Training steps and dense evaluation side by side with DeepSDF's: samples a second, share of the GEMM limit.

    python benchmarks/training.py [--shapes 4] [--samples 4096] [--rounds 5] [--threads N] [overrides]
    python benchmarks/training.py --device cuda --shapes 64 --samples 16384

Every round times one step of each rival, after one that warms up, one rival after the other, so that a
machine's moods hit all alike; printed are medians over the rounds, after two that do not count, and how far
the slowest and the fastest are apart. DeepSDF's step (reference.py) is re-implemented from its description:
its network (weight norm, dropout 0.2, the code concatenated to every point), its sum of clamped L1 over the
batch, its prior |z|, Adam, and its data path, one npz file a shape read anew at every step. It runs in a
process of its own, as its users run it. Two more run in this process and so have its settings of memory and
threads, which are ours: one like it, one with bfloat16 products, which DeepSDF does not have, so that steps
of ours can be compared with their like. Steps of ours include the draw of their samples from the store. Only
samples with a signed distance are counted: what normals cost is on our account. The limit is the rate of a
product [8192, W] x [W, W] on each core, W the width of the decoder, timed in the same rounds.

On a GPU our samples lie in its memory and the decoder is compiled, as `trainer=gpu` does it; DeepSDF's step
is given samples that wait on the device, as if its loaders took no time, and works on a batch in four parts
(its `batch_split`), or it would not fit. float32 products are TF32 there, for all. The second limit:
the bytes that have to move if every product and every pass between two of them reads what it needs and
writes what it makes once, at the rate of a copy. There too encoding=hash, by tensor operations and, where it
is installed, by tiny-cuda-nn.
"""

from runs import at_least, run_benchmark

import sdfhub  # noqa: F401  (before torch: it says how threads wait)

# isort: split
import argparse
import re
import statistics
import tempfile
import time
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch
from hydra import compose, initialize_config_dir
from reference import ReferenceProcess, ReferenceStep

from sdfhub.data.batches import Augmentation, Loading, StepBatches
from sdfhub.data.resident import ResidentBatches
from sdfhub.model.computing import TOGETHER, distances, keep_freed_memory
from sdfhub.side_by_side import side_by_side
from sdfhub.tasks.app import register_resolvers
from sdfhub.tasks.build import plain
from sdfhub.tasks.run import build_autodecoder

CONF = Path(__file__).resolve().parents[1] / "conf"
STORED = 100_000
"""Samples of each kind in a shape's file; a draw does not depend on what they are."""
WARM_UP = 2
"""Rounds that do not count: the reference here is a fifth slower until freed memory is of the right sizes."""
PUBLISHED, REFERENCE = "DeepSDF, as published", "DeepSDF, in our process"
BUSY = 2.5
"""How much slower than in our process DeepSDF's step is in its own where it waits for other programs."""
UNREAD = ("data", "category", "trainer", "callbacks", "evaluate", "fit", "search", "sweeps", "hydra")
"""Groups of a training that a step without data, judging or a loop around it does not read."""
NAMED = ("decoder", "activation", "encoding", "normals", "experiment")
"""Groups whose choices the names of the rows say."""
PAPER_SAMPLES = 2000 * 16_384
"""Samples of a shape in the paper's training."""


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

    def read_into(self, rows: np.ndarray, name: str, start: int) -> None:
        rows[:] = self.read(name, start, len(rows))


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
        config = plain(compose("config", overrides=choice))
        self.model = build_autodecoder(config, rows=len(shapes), steps=1000).to(device)
        self.model.on_fit_start()
        loading = Loading(len(shapes), samples, surface, 1, 0, Augmentation(), 0)
        on_cpu = device.type == "cpu"
        self.batches = StepBatches(shapes, loading) if on_cpu else ResidentBatches(shapes, loading, device)
        configured = self.model.configure_optimizers()
        self.optimizer, self.bf16, self.step = configured["optimizer"], bf16, 0

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
        config = plain(compose("config", overrides=choice))
        self.model, self.bf16 = build_autodecoder(config, rows=1).eval().to(device), False
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


def rivals(args: argparse.Namespace, folder: Path) -> dict[str, object]:
    """The steps to compare, by name."""
    shapes = [RandomShape.drawn(seed) for seed in range(args.shapes)]
    files = [folder / f"{index}.npz" for index in range(args.shapes)]
    for file, shape in zip(files, shapes, strict=True):
        np.savez(file, pos=shape.outside, neg=shape.inside)
    paper = ["decoder=paper_585k", "encoding=fourier", "encoding.frequencies=12", *args.overrides]
    deepsdf = ["experiment=deepsdf", *args.overrides]
    surface = args.samples // 4  # as at scale=paper
    rows = args.shapes * args.samples
    device = torch.device(args.device)
    made: dict[str, object] = {}
    if device.type == "cpu":
        made[PUBLISHED] = ReferenceProcess(files, args.samples, torch.get_num_threads())
    for bf16 in (False, True):
        suffix = ", bf16" if bf16 else ""
        made |= {
            REFERENCE + suffix: ReferenceStep(files, args.samples, device, bf16),
            "decoder=deepsdf" + suffix: OurStep(shapes, args.samples, 0, deepsdf, bf16, device),
            "paper_585k, HOSC, normals=off" + suffix: OurStep(
                shapes, args.samples, 0, ["normals=off", *paper], bf16, device
            ),
            "paper_585k, HOSC, normals=on" + suffix: OurStep(
                shapes, args.samples, surface, paper, bf16, device
            ),
            "paper_585k, SIREN, normals=on" + suffix: OurStep(
                shapes, args.samples, surface, ["activation=siren", *paper], bf16, device
            ),
        }
    made |= hash_steps(shapes, args, device)
    fields = {
        "decoder=deepsdf": deepsdf,
        "paper_585k, HOSC": paper,
        "paper_585k, SIREN": ["activation=siren", *paper],
    }
    made |= {f"{name}, evaluation": OurField(choice, rows, device) for name, choice in fields.items()}
    return made


def hash_steps(
    shapes: list[RandomShape], args: argparse.Namespace, device: torch.device
) -> dict[str, object]:
    """Steps with a hash encoding, by each of the ways to compute it that there are here."""
    ways = {"tensor operations": "false"} | ({"tiny-cuda-nn": "true"} if find_spec("tinycudann") else {})
    choice = ["decoder=paper_585k", "encoding=hash", *args.overrides]
    return {
        f"paper_585k, HOSC + hash by {name}, normals=on, bf16": OurStep(
            shapes, args.samples, args.samples // 4, [*choice, f"computing.tinycudann={there}"], True, device
        )
        for name, there in ways.items()
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--shapes", type=at_least(1), default=4)
    parser.add_argument("--samples", type=at_least(2), default=4096)
    parser.add_argument("--rounds", type=at_least(3), default=5)
    parser.add_argument("--threads", type=at_least(1), help="default: what torch takes")
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"))
    parser.add_argument("overrides", nargs="*")
    args = parser.parse_args()
    if args.device == "cuda" and not torch.cuda.is_available():
        parser.error("--device cuda: PyTorch finds no GPU here")
    for override in args.overrides:
        if re.split("[.=]", override.lstrip("+~"))[0] in UNREAD:
            parser.error(f"{override}: no step here reads it; --shapes and --samples say what a batch has")
        if override.lstrip("+~").partition("=")[0] in NAMED:
            parser.error(f"{override}: the rows to compare differ in it, and their names say how")
    if args.threads:
        torch.set_num_threads(args.threads)
    register_resolvers()
    keep_freed_memory()  # for the references here too
    torch._dynamo.config.recompile_limit = 64  # each decoder is a version; else late ones run plain
    torch.manual_seed(0)
    with (
        tempfile.TemporaryDirectory() as folder,
        initialize_config_dir(str(CONF), version_base=None),
    ):
        steps = rivals(args, Path(folder))
        limits = limits_of(steps, torch.device(args.device))
        times = {name: [] for name in (*steps, *limits)}
        for round_ in range(args.rounds + WARM_UP):
            for name, step in (steps | limits).items():
                taken = seconds_of(step, args.device == "cuda")
                if round_ >= WARM_UP:
                    times[name].append(taken)
        if PUBLISHED in steps:
            steps[PUBLISHED].close()
    report(args, steps, limits, times)


def seconds_of(step, on_gpu: bool) -> float:
    """How long a step takes after another, which may compile; on a GPU the mean of ten."""
    step()
    if not on_gpu:
        start = time.perf_counter()
        step()
        return time.perf_counter() - start
    torch.cuda.synchronize()
    start = time.perf_counter()
    for _ in range(10):
        step()
    torch.cuda.synchronize()
    return (time.perf_counter() - start) / 10


def limits_of(steps: dict[str, object], device: torch.device) -> dict[object, Product | Copy]:
    """The products to measure, by width and whether they are bfloat16, and on a GPU a copy."""
    made: dict[object, Product | Copy] = {} if device.type == "cpu" else {"copy": Copy(device)}
    for step in steps.values():
        if hasattr(step, "operations"):
            key = limit_of(step)
            dtype = torch.bfloat16 if key[1] else torch.float32
            made[key] = Product(key[0], dtype, TOGETHER[device.type], device)
    return made


def limit_of(step) -> tuple[int, bool]:
    """Width of a step's decoder, and whether its products are bfloat16."""
    return max(sum(layer.columns[:2]) for layer in step.model.decoder.layers), step.bf16


def report(args: argparse.Namespace, steps: dict, limits: dict, times: dict[str, list[float]]) -> None:
    """Prints Markdown tables."""
    seconds = {name: statistics.median(taken) for name, taken in times.items()}
    rows = args.shapes * args.samples
    copy = limits.pop("copy", None)
    rate = {key: product.operations() / seconds[key] for key, product in limits.items()}
    device = f"{torch.get_num_threads()} threads" if copy is None else torch.cuda.get_device_name()
    print(f"{device}, {args.shapes} shapes x {args.samples} samples a step")
    for (width, bf16), value in rate.items():
        dtype = "bfloat16" if bf16 else "float32"
        print(f"product {width} wide, {dtype}: {value / 1e9:.0f} G operations a second, all threads together")
    if copy:
        print(f"copy: {copy.bytes() / seconds['copy'] / 1e9:.0f} GB a second, read and written")
    memory = " | of the copy's" if copy else ""
    print(
        "\n| step | samples/s | apart | times DeepSDF | in our process | and in bf16 "
        f"| share of the product's rate{memory} |"
    )
    print("| --- " * (7 + bool(copy)) + "|")
    for name, step in steps.items():
        shares = [0.0] * (1 + bool(copy))
        if hasattr(step, "operations"):
            shares[0] = step.operations() / seconds[name] / rate[limit_of(step)]
        if copy and hasattr(step, "bytes"):
            shares[1] = step.bytes() / seconds[name] / (copy.bytes() / seconds["copy"])
        apart = (max(times[name]) - min(times[name])) / seconds[name]
        faster = ["", "", ""]
        if not isinstance(step, OurField):
            others = [PUBLISHED, REFERENCE, *([f"{REFERENCE}, bf16"] if step.bf16 else [])]
            compared = [
                f"{seconds[other] / seconds[name]:.2f}" if other in seconds else "" for other in others
            ]
            faster[: len(compared)] = compared
        cells = " | ".join([*faster, *(f"{share:.2f}" if share else "" for share in shares)])
        print(f"| {name} | {rows / seconds[name]:,.0f} | {apart:.0%} | {cells} |")
    if PUBLISHED in seconds and seconds[PUBLISHED] > BUSY * seconds[REFERENCE]:
        print("\nDeepSDF's own process is that slow where others are at work: go by 'in our process'")
    for bf16 in ("", ", bf16"):
        on, off = (seconds[f"paper_585k, HOSC, normals={choice}{bf16}"] for choice in ("on", "off"))
        print(f"\nnormals=on takes {on / off:.2f} times the step of normals=off{bf16}")
    paper = steps["paper_585k, HOSC, normals=on, bf16"]
    print(
        f"\na sample of it, bf16: {paper.operations() / rows / 1e6:.2f} M operations, "
        f"{paper.bytes() / rows / 1e3:.1f} kB moved at least"
    )
    hours = [PAPER_SAMPLES * shapes * on / rows / 3600 for shapes in (100, 1000)]
    print(
        f"\nthe paper's training at that rate: {hours[0]:.2f} hours for 100 shapes, {hours[1]:.1f} for 1000"
    )


if __name__ == "__main__":
    run_benchmark(main)
