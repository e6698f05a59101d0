"""Unseen shapes fitted by DeepSDF's recipe, one by one, and by Gauss-Newton, all at once.

    python benchmarks/fitting.py [--space RUN] [--experiment fft_hosc] [--reference 4] [--shapes 32]

Without --space it trains one first (scale=cpu_200: 200 procedural chairs) in outputs/benchmarks/. Its unseen
shapes are fitted by `fit=gauss_newton` side by side, twice (two seeds: start and samples), which shows the
noise; the first --reference of them also by `fit=deepsdf` (800 Adam steps x 8000 samples) one by one, between
the two. One thread; seconds are the processor's, so that other programs do not count. Objective: clamped
L1 + prior on 40,000 fresh samples. CD: at 128^3, 30,000 points a side. Both times 10^3. The last table
compares the same shapes by both; noise: median |difference| of the two seeds on all shapes.
"""

import argparse
import time
from pathlib import Path

import numpy as np
import torch
import yaml
from runs import ROOT, at_least, run_benchmark, train

import sdfhub
from sdfhub.data.loading.batches import signed_samples
from sdfhub.data.splits import split
from sdfhub.data.store.stored_shape import StoredShape
from sdfhub.geometry.metrics import judge
from sdfhub.model.decoder import Decoder
from sdfhub.model.losses import clamped_l1
from sdfhub.space import reconstruct
from sdfhub.tasks.build import build
from sdfhub.tasks.evaluate import Evaluation, fit_held_out
from sdfhub.tasks.run import read_run

FRESH = 40_000
"""Samples of a shape on which its objective is measured, drawn apart from those of the fits."""


def unseen_shapes(space: Path, count: int) -> list[StoredShape]:
    """Shapes of the space's source that it was not trained on, prepared as its own were."""
    config, roles = read_run(space)
    data = build(config["data"] | {"workers": 1}, "data", within="sdfhub.data")
    others = [shape for shape in data.source.shapes() if shape.id not in roles["train"]]
    return list(data.filled(split(others, 0, count, seed=1)).values())


def evaluation(fit: str, together: int, seed: int) -> Evaluation:
    node = yaml.safe_load((ROOT / "conf" / "fit" / f"{fit}.yaml").read_text())
    return Evaluation(128, 30_000, None, None, build(node, "fit"), together, 0, seed=seed)


def timed(decoder: Decoder, shapes: list[StoredShape], how: Evaluation) -> tuple[torch.Tensor, float]:
    start = time.process_time()
    return fit_held_out(decoder, shapes, how), time.process_time() - start


@torch.no_grad()
def quality(decoder: Decoder, shape: StoredShape, code: torch.Tensor) -> tuple[float, float]:
    """Objective on fresh samples, and CD of the reconstruction."""
    rows = torch.from_numpy(signed_samples(shape, FRESH, np.random.default_rng(2**40)))[None]
    field = decoder(rows[..., :3], code[None])
    objective = clamped_l1(field, rows[..., 3], 0.1) + 1e-4 * code.square().mean()
    cd = judge(*reconstruct(decoder, code[None], 128), shape.mesh).cd
    return float(objective) * 1e3, np.nan if cd is None else cd * 1e3


def compare(decoder: Decoder, shapes: list[StoredShape], reference: int) -> None:
    quick, seconds = [], 0.0
    for seed in (0, 1):
        codes, spent = timed(decoder, shapes, evaluation("gauss_newton", len(shapes), seed))
        quick.append(np.array([quality(decoder, *pair) for pair in zip(shapes, codes, strict=True)]))
        seconds += spent / 2 / len(shapes)
        line = f"gauss_newton, seed {seed}: {spent / len(shapes):.2f} s a shape; objective, CD median "
        print(line + str(np.nanmedian(quick[-1], axis=0).round(4)), flush=True)
    slow, times = [], []
    print("\n| shape | deepsdf s | objective | CD | gauss_newton objective | CD |\n" + "| --- " * 6 + "|")
    for index, shape in enumerate(shapes[:reference]):
        code, spent = timed(decoder, [shape], evaluation("deepsdf", 1, 0))
        times.append(spent)
        slow.append(quality(decoder, shape, code[0]))
        cells = [f"{value:.4f}" for value in (*slow[-1], *quick[0][index])]
        print(f"| {shape.id} | {spent:.1f} | {' | '.join(cells)} |", flush=True)
    report(quick, np.array(slow), np.mean(times) / seconds)


def report(quick: list[np.ndarray], slow: np.ndarray, ratio: float) -> None:
    count = len(slow)
    print(f"\nseconds a shape: deepsdf / gauss_newton = {ratio:.1f}\n")
    print("| | deepsdf mean | median | gauss_newton mean | median | difference, median of shapes | noise |")
    print("| --- " * 7 + "|")
    for column, name in enumerate(("objective", "CD")):
        ours, theirs = quick[0][:count, column], slow[:, column]
        values = [np.nanmean(theirs), np.nanmedian(theirs), np.nanmean(ours), np.nanmedian(ours)]
        noise = np.nanmedian(np.abs(quick[0] - quick[1])[:, column])
        values += [np.nanmedian(ours - theirs), noise]
        print(f"| {name} | " + " | ".join(f"{value:.4f}" for value in values) + " |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--space", type=Path, help="folder of a trained run")
    parser.add_argument("--experiment", default="fft_siren", help="what to train where no run is given")
    parser.add_argument("--shapes", type=at_least(1), default=32)
    parser.add_argument("--reference", type=at_least(0), default=4, help="of these also by DeepSDF's recipe")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if (space := arguments.space) is None:
        name = f"fitting_{arguments.experiment}"
        settings = ["scale=cpu_200", "callbacks=none", "evaluate.train=1", "evaluate.held_out=0"]
        train(name, f"experiment={arguments.experiment}", *settings)
        space = ROOT / "outputs" / "benchmarks" / name
    compare(
        sdfhub.load(space, device="cpu").decoder, unseen_shapes(space, arguments.shapes), arguments.reference
    )


if __name__ == "__main__":
    run_benchmark(main)
