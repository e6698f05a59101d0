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
from runs import OUTPUTS, head, row, train

import sdfhub
from sdfhub.data.splits import split
from sdfhub.data.store.store import shape_seed
from sdfhub.data.store.stored_shape import StoredShape, signed_samples
from sdfhub.geometry.metrics import judge
from sdfhub.latent.deepsdf_fit import DeepSdfFit
from sdfhub.latent.fitting import Fit
from sdfhub.latent.gauss_newton import GaussNewtonFit
from sdfhub.model.losses import clamped_l1
from sdfhub.opening import data_of, read_run
from sdfhub.scans.observed_scan import observations_of

FRESH = 40_000
"""Samples of a shape on which its objective is measured, drawn apart from those of the fits."""


def unseen_shapes(run: Path, count: int) -> list[StoredShape]:
    """Shapes of the run's source that it was not trained on, prepared as its own were."""
    config, roles = read_run(run)
    data = data_of(config)
    others = [shape for shape in data.source.shapes() if shape.id not in roles["train"]]
    return list(data.filled(split(others, 0, count, seed=1)).values())


def timed(
    space: sdfhub.Space, shapes: list[StoredShape], fit: Fit, seed: int = 0
) -> tuple[torch.Tensor, float]:
    """Codes [S, L] and processor seconds."""
    start = time.process_time()
    observations = observations_of(shapes, fit.samples, [shape_seed(shape) ^ seed for shape in shapes])
    codes = fit(space.decoder, space.codes, observations, space.delta).codes
    return codes, time.process_time() - start


@torch.no_grad()
def quality(space: sdfhub.Space, shape: StoredShape, code: torch.Tensor) -> tuple[float, float]:
    """Objective on fresh samples, and CD of the reconstruction."""
    rows = torch.from_numpy(signed_samples(shape, FRESH, np.random.default_rng(2**40)))[None]
    field = space.decoder(rows[..., :3], code[None])
    objective = clamped_l1(field, rows[..., 3], space.delta) + 1e-4 * code.square().mean()
    cd = judge(space.mesh(code, 128), shape.mesh).cd
    return float(objective) * 1e3, np.nan if cd is None else cd * 1e3


def compare(space: sdfhub.Space, shapes: list[StoredShape], reference: int) -> None:
    quick, seconds = [], []
    for seed in (0, 1):
        codes, spent = timed(space, shapes, GaussNewtonFit(seed=seed), seed)
        quick.append(np.array([quality(space, *pair) for pair in zip(shapes, codes, strict=True)]))
        seconds.append(spent / len(shapes))
        line = f"gauss_newton, seed {seed}: {seconds[-1]:.2f} s a shape; objective, CD median "
        print(line + str(np.nanmedian(quick[-1], axis=0).round(4)), flush=True)
    slow, times = [], []
    head("shape | deepsdf s | objective | CD | gauss_newton objective | CD")
    for index, shape in enumerate(shapes[:reference]):
        code, spent = timed(space, [shape], DeepSdfFit())
        times.append(spent)
        slow.append(quality(space, shape, code[0]))
        row(shape.id, f"{spent:.1f}", *(f"{value:.4f}" for value in (*slow[-1], *quick[0][index])))
    if slow:
        report(quick, np.array(slow), np.mean(times) / np.mean(seconds))


def report(quick: list[np.ndarray], slow: np.ndarray, ratio: float) -> None:
    print(f"\nseconds a shape: deepsdf / gauss_newton = {ratio:.1f}")
    head(" | deepsdf mean | median | gauss_newton mean | median | difference, median of shapes | noise")
    for column, name in enumerate(("objective", "CD")):
        ours, theirs = quick[0][: len(slow), column], slow[:, column]
        values = [np.nanmean(theirs), np.nanmedian(theirs), np.nanmean(ours), np.nanmedian(ours)]
        values += [np.nanmedian(ours - theirs), np.nanmedian(np.abs(quick[0] - quick[1])[:, column])]
        row(name, *(f"{value:.4f}" for value in values))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--space", type=Path, help="folder of a trained run")
    parser.add_argument("--experiment", default="fft_siren", help="what to train where no run is given")
    parser.add_argument("--shapes", type=int, default=32)
    parser.add_argument("--reference", type=int, default=4, help="of these also by DeepSDF's recipe")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    run = arguments.space
    if run is None:
        run = OUTPUTS / f"fitting_{arguments.experiment}"
        settings = ["scale=cpu_200", "callbacks=none", "evaluate.train=1", "evaluate.held_out=0"]
        train(run.name, f"experiment={arguments.experiment}", *settings)
    compare(sdfhub.load(run, "cpu"), unseen_shapes(run, arguments.shapes), arguments.reference)


if __name__ == "__main__":
    main()
