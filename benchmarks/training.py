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

import sdfhub  # noqa: F401  (before torch: it says how threads wait)

# isort: split
import argparse
import statistics
import tempfile
import time
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch
from hydra import initialize_config_dir
from reference import ReferenceProcess, ReferenceStep
from runs import head, row
from steps import Copy, OurField, OurStep, Product, RandomShape

from sdfhub.composition import configuration_folder
from sdfhub.model.fast.computing import TOGETHER, keep_freed_memory

WARM_UP = 2
"""Rounds that do not count: the reference here is a fifth slower until freed memory is of the right sizes."""
PUBLISHED, REFERENCE = "DeepSDF, as published", "DeepSDF, in our process"
BUSY = 2.5
"""How much slower than in our process DeepSDF's step is in its own where it waits for other programs."""
PAPER_SAMPLES = 2000 * 16_384
"""Samples of a shape in the paper's training."""


def rivals(args: argparse.Namespace, folder: Path) -> dict[str, object]:
    """The steps to compare, by name."""
    shapes = [RandomShape.drawn(seed) for seed in range(args.shapes)]
    files = [folder / f"{index}.npz" for index in range(args.shapes)]
    for file, shape in zip(files, shapes, strict=True):
        np.savez(file, pos=shape.read("outside"), neg=shape.read("inside"))
    device, surface = torch.device(args.device), args.samples // 4  # as at scale=paper
    large = ["decoder=paper_585k", *args.overrides]
    paper = ["encoding=fourier", "encoding.frequencies=12", *large]
    deepsdf, siren = ["experiment=deepsdf", *args.overrides], ["activation=siren", *paper]

    def ours(choice: list[str], points: int, bf16: bool) -> OurStep:
        return OurStep(shapes, args.samples, points, choice, bf16, device)

    made: dict[str, object] = {}
    if device.type == "cpu":
        made[PUBLISHED] = ReferenceProcess(files, args.samples, torch.get_num_threads())
    for bf16, suffix in ((False, ""), (True, ", bf16")):
        made |= {
            REFERENCE + suffix: ReferenceStep(files, args.samples, device, bf16),
            "decoder=deepsdf" + suffix: ours(deepsdf, 0, bf16),
            "paper_585k, HOSC, normals=off" + suffix: ours(["normals=off", *paper], 0, bf16),
            "paper_585k, HOSC, normals=on" + suffix: ours(paper, surface, bf16),
            "paper_585k, SIREN, normals=on" + suffix: ours(siren, surface, bf16),
        }
    ways = {"tensor operations": "false"} | ({"tiny-cuda-nn": "true"} if find_spec("tinycudann") else {})
    for name, there in ways.items():
        choice = ["encoding=hash", f"computing.tinycudann={there}", *large]
        made[f"paper_585k, HOSC + hash by {name}, normals=on, bf16"] = ours(choice, surface, True)
    fields = {"decoder=deepsdf": deepsdf, "paper_585k, HOSC": paper, "paper_585k, SIREN": siren}
    rows = args.shapes * args.samples
    made |= {f"{name}, evaluation": OurField(choice, rows, device) for name, choice in fields.items()}
    return made


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--shapes", type=int, default=4)
    parser.add_argument("--samples", type=int, default=4096)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--threads", type=int, help="default: what torch takes")
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"))
    parser.add_argument("overrides", nargs="*", help="of every row's training: those that a step reads")
    args = parser.parse_args()
    if args.threads:
        torch.set_num_threads(args.threads)
    keep_freed_memory()  # for the references here too
    torch._dynamo.config.recompile_limit = 64  # each decoder is a version; else late ones run plain
    torch.manual_seed(0)
    with (
        tempfile.TemporaryDirectory() as folder,
        initialize_config_dir(str(configuration_folder()), version_base="1.3"),
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
    count, wait = (10, torch.cuda.synchronize) if on_gpu else (1, lambda: None)
    step()
    wait()
    start = time.perf_counter()
    for _ in range(count):
        step()
    wait()
    return (time.perf_counter() - start) / count


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
        copy_rate = copy.bytes() / seconds["copy"]
        print(f"copy: {copy_rate / 1e9:.0f} GB a second, read and written")
    rates = "times DeepSDF | in our process | and in bf16 | share of the product's rate"
    head(f"step | samples/s | apart | {rates}{' | of the copy' * bool(copy)}")
    for name, step in steps.items():
        others = [PUBLISHED, REFERENCE, f"{REFERENCE}, bf16"] if not isinstance(step, OurField) else []
        apart, others = (max(times[name]) - min(times[name])) / seconds[name], others[: 2 + step.bf16]
        cells = [f"{rows / seconds[name]:,.0f}", f"{apart:.0%}"]
        cells += [f"{seconds[other] / seconds[name]:.2f}" if other in seconds else "" for other in others]
        cells += [""] * (5 - len(cells))
        is_ours = hasattr(step, "operations")
        share = step.operations() / seconds[name] / rate[limit_of(step)] if is_ours else 0
        cells.append(f"{share:.2f}" if share else "")
        if copy:
            share = step.bytes() / seconds[name] / copy_rate if hasattr(step, "bytes") else 0
            cells.append(f"{share:.2f}" if share else "")
        row(name, *cells)
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
    main()
