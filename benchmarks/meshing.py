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
from dense_meshing import mesh_dense
from runs import OUTPUTS, head, row, train
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from sdfhub.geometry.mesher import mesh_field
from sdfhub.model.autodecoder import AutoDecoder
from sdfhub.model.saved import built_parts

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

    def __call__(self, points: torch.Tensor) -> torch.Tensor:
        start = time.process_time()
        values = self.field(points)
        self.seconds += time.process_time() - start
        self.points += values.numel()
        return values


def space(name: str, shapes: int) -> AutoDecoder:
    """The trained model of a space, trained first if it is not there yet; `untrained` needs no training."""
    if name == "untrained":
        trained = space("chairs", shapes)
        torch.manual_seed(0)
        return shifted(AutoDecoder(**built_parts(trained.hparams, Path(name))).eval())
    run = OUTPUTS / f"meshing_{name}_{shapes}"
    if not (run / "metrics.json").exists():
        train(run.name, *SMALL, *SPACES[name], f"data.shapes={shapes}")
    return AutoDecoder.load_from_checkpoint(run / "checkpoints" / "last.ckpt").eval()


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


def compared(name: str, model: AutoDecoder, resolution: int, shapes: int) -> None:
    """Prints a line of the first table."""
    rows = []
    for shape in range(shapes):
        field = field_of(model, shape)
        want = mesh_dense(field, resolution)
        field.points = 0
        rows.append((*compare(mesh_field(field, resolution), want), resolution**3 / field.points))
    apart, missed, same, fewer = map(np.array, zip(*rows, strict=True))
    cells = f"{apart.max():.1e}", f"{same.sum()} of {shapes}", f"{fewer.min():.1f}", f"{np.median(fewer):.1f}"
    row(name, f"{resolution}^3", shapes, sum(missed), *cells)


def measured(name: str, model: AutoDecoder, resolution: int, dense: int, shapes: int) -> None:
    """Prints a line of the second table."""
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
    row(name, shapes, *cells, f"{np.median(share):.0%}")


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
    parser.add_argument("--shapes", type=int, help="a space, all compared and timed")
    parser.add_argument("--compare", type=int, default=96, help="resolution of the comparison")
    parser.add_argument("--dense", type=int, default=1, help="shapes whose dense mesh is timed, at 256^3")
    parser.add_argument("--spaces", nargs="+", choices=names, default=names)
    parser.add_argument("--only", choices=("compared", "measured"))
    parser.add_argument("--peak", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    shapes = arguments.shapes or (100 if arguments.whole else 4)
    torch.set_num_threads(1)
    if arguments.peak:
        return peak_memory(arguments.peak, shapes)
    models = {name: space(name, shapes) for name in arguments.spaces}
    fewer = "fewer evaluations min | median"
    if arguments.only != "measured":
        head(f"space | grid | shapes | pieces missed | vertices apart | same mesh | {fewer}")
        for name, model in models.items():
            compared(name, model, arguments.compare, shapes if name in CATEGORIES else min(shapes, ROUGH))
    if arguments.only != "compared":
        head(f"space | shapes | dense s | ours s | ratio min | median | {fewer} | time in the field")
        for name in [name for name in CATEGORIES if name in models]:
            measured(name, models[name], 256, arguments.dense, shapes)
        print(f"\n{peak_elsewhere(min(models), shapes)}")


if __name__ == "__main__":
    main()
