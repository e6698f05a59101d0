"""Meshing: every node of the grid against coarse to fine, on spaces trained here.

    python benchmarks/meshing.py                 # 4 shapes a space: minutes
    python benchmarks/meshing.py --whole         # 100 shapes a space: most of an hour

Trains a space of each procedural category once, with the decoder and the settings of scale=cpu_200, and keeps
it below outputs/benchmarks; beside them a ReLU space without encoding, one that has hardly begun to train,
and one untrained: their rough fields are where a piece of surface is most easily missed. Prints two Markdown
tables.

Compared: each shape's mesh against its dense twin, at 96^3 (--compare), where the coarsest cells are larger
than at 256^3 (24 an axis against 32). Timed: seconds of one core (process time: what other
processes take does not count), the dense mesh on the first shapes, ours on all, both in turns.
Peak memory: a process that loads the space and meshes its first shape at 512^3.
"""

import argparse
import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import torch
from runs import ROOT, at_least, run_benchmark, train
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from sdfhub.geometry.mesher import mesh_dense, mesh_field, mesh_fields
from sdfhub.model.autodecoder import AutoDecoder
from sdfhub.tasks.run import build_autodecoder, put_weights, read_run, read_weights

TOLERANCE = 1e-6
SMALL = [
    "scale=cpu_200",
    "data.held_out=0",
    "data.preparation.samples=50000",
    "callbacks=none",
    "evaluate.train=0",
]
ROUGH = 10  # shapes compared of a space that is no trained category
CATEGORIES = ("chairs", "lamps", "planes", "sofas", "tables")
SPACES = {name: [f"category={name}", "experiment=fft_siren"] for name in CATEGORIES} | {
    "relu": ["category=chairs", "activation=relu", "encoding=none", "normals=off"],
    "short": ["category=lamps", "experiment=fft_hosc", "trainer.max_epochs=3"],
}


class Measured:
    """A field that knows how many points it was asked for and how long it took."""

    def __init__(self, field):
        self.field, self.points, self.seconds = field, 0, 0.0

    def __call__(self, points: torch.Tensor, *shapes: torch.Tensor) -> torch.Tensor:
        start = time.process_time()
        values = self.field(points, *shapes)
        self.seconds += time.process_time() - start
        self.points += values.numel()
        return values


def space(name: str, shapes: int) -> AutoDecoder:
    """The trained model of a space, trained first if it is not there yet; `untrained` needs no training."""
    if name == "untrained":
        space("chairs", shapes)  # for its settings
        config, _ = read_run(folder("chairs", shapes))
        return shifted(build_autodecoder(config, shapes).eval())
    last = folder(name, shapes) / "checkpoints" / "last.ckpt"
    if not (folder(name, shapes) / "metrics.json").exists():
        train(folder(name, shapes).name, *SMALL, *SPACES[name], f"data.shapes={shapes}")
    model = build_autodecoder(read_run(folder(name, shapes))[0], shapes)
    put_weights(model, read_weights(last), last)
    return model.eval()


def folder(name: str, shapes: int) -> Path:
    return ROOT / "outputs" / "benchmarks" / f"meshing_{name}_{shapes}"


@torch.no_grad()
def shifted(model: AutoDecoder) -> AutoDecoder:
    """The model with a tenth of the cube inside its first shape: an untrained one may have no surface."""
    head, points = model.decoder.layers[-1].linear, 2 * torch.rand(1, 4096, 3) - 1
    head.bias -= model.decoder(points, model.codes.table[:1]).quantile(0.1)
    return model


def field_of(model: AutoDecoder, shape: int):
    code = model.codes.table.detach()[shape]
    return Measured(lambda points: model.decoder(points[None], code[None])[0])


def timed(mesh, *arguments, **options):
    start = time.process_time()
    result = mesh(*arguments, **options)
    return result, time.process_time() - start


def compare(have, want) -> tuple[float, int, bool]:
    """Largest distance between partners, pieces of `want` with vertices that lack one, the same mesh?"""
    (vertices, _), (dense, faces) = have, want
    if not (len(vertices) and len(dense)):
        return 0.0, pieces(faces, np.ones(len(dense), bool)), len(vertices) == len(dense)
    there, back = cKDTree(vertices).query(dense)[0], cKDTree(dense).query(vertices)[0]
    found = np.concatenate([there[there <= TOLERANCE], back[back <= TOLERANCE]])
    same = len(have[1]) == len(faces) and bool((back <= TOLERANCE).all())
    return found.max(initial=0), pieces(faces, there > TOLERANCE), same


def pieces(faces: np.ndarray, lacking: np.ndarray) -> int:
    """How many connected pieces of a mesh have vertices without a partner."""
    a, b = np.concatenate([faces[:, :2], faces[:, 1:]]).T
    graph = coo_array((np.ones(len(a), bool), (a, b)), shape=(len(lacking),) * 2)
    return len(np.unique(connected_components(graph)[1][lacking]))


def compared(name: str, model: AutoDecoder, resolution: int, shapes: int) -> str:
    """A line of the first table."""
    rows = []
    for shape in range(shapes):
        field = field_of(model, shape)
        want = mesh_dense(field, resolution)
        field.points = 0
        rows.append((*compare(mesh_field(field, resolution), want), resolution**3 / field.points))
    apart, missed, same, fewer = map(np.array, zip(*rows, strict=True))
    cells = f"{resolution}^3 | {shapes} | {sum(missed)} | {apart.max():.1e} | {same.sum()} of {shapes}"
    return f"| {name} | {cells} | {fewer.min():.1f} | {np.median(fewer):.1f} |"


def measured(name: str, model: AutoDecoder, resolution: int, dense: int, shapes: int) -> str:
    """A line of the second table."""
    dense_seconds, seconds, share, fewer = [], [], [], []
    for shape in range(shapes):
        if shape < dense:
            dense_seconds.append(timed(mesh_dense, field_of(model, shape), resolution)[1])
        field = field_of(model, shape)
        seconds.append(timed(mesh_field, field, resolution)[1])
        share.append(field.seconds / seconds[-1])
        fewer.append(resolution**3 / field.points)
    ratio = min(dense_seconds) / np.array(seconds)
    cells = [f"{min(dense_seconds):.1f}", f"{np.median(seconds):.2f}", f"{ratio.min():.1f}"]
    cells += [f"{np.median(ratio):.1f}", f"{min(fewer):.1f}", f"{np.median(fewer):.1f}"]
    return f"| {name} | {shapes} | {' | '.join(cells)} | {np.median(share):.0%} |"


def together(model: AutoDecoder, resolution: int, shapes: int) -> str:
    """Meshing shapes together against one after another, in turns: a line."""
    codes, best = model.codes.table.detach(), [np.inf, np.inf]
    for _ in range(2):
        _, one = timed(lambda: [mesh_field(field_of(model, row), resolution) for row in range(shapes)])
        fields = Measured(lambda points, rows: model.decoder(points, codes[rows]))
        _, many = timed(lambda fields=fields: list(mesh_fields(fields, shapes, resolution)))
        best = [min(best[0], one), min(best[1], many)]
    return f"{shapes} shapes at {resolution}^3 together: {best[0] / best[1]:.2f} x as fast as one by one"


def head(columns: str) -> str:
    names = columns.split(", ")
    return f"\n| {' | '.join(names)} |\n|{' --- |' * len(names)}"


def peak_memory(name: str, shapes: int) -> None:
    """Prints MiB resident after loading, and at most, while this process meshes at 512^3."""
    model = space(name, shapes)
    loaded = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    mesh_field(field_of(model, 0), 512)
    print(f"{loaded / 1024:.0f} {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f}")


def peak_elsewhere(name: str, shapes: int) -> str:
    command = [sys.executable, __file__, "--peak", name, "--shapes", str(shapes)]
    loaded, peak = subprocess.check_output(command, text=True).split()[-2:]
    return f"{name}, shape 0 at 512^3: at most {peak} MiB, of them {loaded} before meshing"


def main() -> None:
    names = [*SPACES, "untrained"]
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--whole", action="store_true", help="100 shapes a space")
    parser.add_argument("--shapes", type=at_least(1), help="a space, all compared and timed")
    parser.add_argument("--compare", type=at_least(2), default=96, help="resolution of the comparison")
    parser.add_argument(
        "--dense", type=at_least(1), default=1, help="shapes whose dense mesh is timed, at 256^3"
    )
    parser.add_argument("--spaces", nargs="+", choices=names, default=names)
    parser.add_argument("--only", choices=("compared", "measured"))
    parser.add_argument("--peak", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    shapes = arguments.shapes or (100 if arguments.whole else 4)
    torch.set_num_threads(1)
    if arguments.peak:
        return peak_memory(arguments.peak, shapes)
    models = {name: space(name, shapes) for name in arguments.spaces}
    if arguments.only != "measured":
        print(
            head(
                "space, grid, shapes, pieces missed, vertices apart, same mesh, fewer evaluations min, median"
            )
        )
        for name, model in models.items():
            some = shapes if name in CATEGORIES else min(shapes, ROUGH)
            print(compared(name, model, arguments.compare, some), flush=True)
    if arguments.only != "compared":
        timings = "shapes, dense s, ours s, ratio min, median, fewer evaluations min, median"
        print(head(f"space, {timings}, time in the field"))
        for name in [name for name in CATEGORIES if name in models]:
            print(measured(name, models[name], 256, arguments.dense, shapes), flush=True)
        first = min(models)
        print(f"\n{together(models[first], 64, 4)}\n{peak_elsewhere(first, shapes)}")


if __name__ == "__main__":
    run_benchmark(main)
