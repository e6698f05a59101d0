"""Preparation: how fast one core makes signed samples of a mesh, and how many signs are right on broken ones.

Run: python benchmarks/preparation.py [FOLDER | open] [--samples 500000] [--limit 20]

`open` stands for the furniture of data=open (`make data` fetches it), evenly over its categories. Without a
folder the meshes are procedural chairs, each also with half its faces turned, so that both paths are timed.
The second table breaks closed shapes in known ways and compares the rival sign methods with the truth of the
clean twin.
"""

import argparse
import os
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

for name in ("OMP_NUM_THREADS", "IGL_NUM_THREADS"):  # a rate per core needs one thread
    os.environ[name] = "1"
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np  # noqa: E402
import trimesh  # noqa: E402
from manifold3d import Manifold, OpType  # noqa: E402

from sdfhub.data import sampling  # noqa: E402
from sdfhub.data.preparation import Preparation  # noqa: E402
from sdfhub.data.procedural import generate  # noqa: E402
from sdfhub.data.signs import SIGN_METHODS  # noqa: E402
from sdfhub.data.sources import OpenSource  # noqa: E402
from sdfhub.errors import RejectedMesh  # noqa: E402
from tests.broken_twins import BREAKAGES, Triangles, chair_parts, errors, flipped, refined, ring, triangles  # noqa: E402
from tests.categories import CATEGORIES  # noqa: E402

SUFFIXES = {".obj", ".ply", ".stl", ".off", ".glb"}
STAGES = {"visible_surface": "rays", "nearest_points": "distance"}


class Stopwatch:
    """Processor seconds spent in the stages of preparation, by name."""

    def __init__(self):
        self.seconds = defaultdict(float)
        for function, stage in STAGES.items():
            setattr(sampling, function, self._timed(getattr(sampling, function), stage))
        for name, method in SIGN_METHODS.items():
            SIGN_METHODS[name] = self._timed(method, "sign")

    def _timed(self, function, stage: str):
        def run(*args):
            start = time.process_time()
            try:
                return function(*args)
            finally:
                self.seconds[stage] += time.process_time() - start

        return run


def meshes(folder: Path | None, limit: int) -> Iterator[tuple[str, Triangles]]:
    """Names and triangles of the meshes in a folder, or of procedural chairs, whole and half turned."""
    if folder is None:
        for index in range(limit):
            chair = generate("chairs", index)
            yield f"chair {index}", chair
            yield f"chair {index}, half turned", flipped(chair, np.random.default_rng(index))
        return
    if folder == Path("open"):
        source = OpenSource({name: rule for name, rule in CATEGORIES.items() if name != "planes"})
        shapes = source.shapes()
        for shape in shapes[:: max(1, len(shapes) // limit)][:limit]:
            yield shape.id, source.load(shape)
        return
    paths = sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES)
    for path in paths[:: max(1, len(paths) // limit)][:limit]:
        mesh = trimesh.load_mesh(path, process=False)
        yield path.stem, (np.asarray(mesh.vertices), np.asarray(mesh.faces))


def print_rates(folder: Path | None, limit: int, preparation: Preparation) -> None:
    """Samples a second and core, the stages' shares of the time, and what was rejected."""
    watch, rates, rejected = Stopwatch(), [], Counter()
    print(f"{'mesh':34} {'faces':>7} {'samples/s':>10} {'rays':>6} {'dist.':>6} {'sign':>6} {'rest':>6}")
    for name, mesh in meshes(folder, limit):
        watch.seconds.clear()
        start = time.process_time()
        try:
            sampling.prepare_mesh(mesh, preparation)
        except RejectedMesh as error:
            rejected[error.reason] += 1
            print(f"{name[:34]:34} {len(mesh[1]):7} rejected: {error}")
            continue
        total = time.process_time() - start
        shares = [watch.seconds[stage] / total for stage in ("rays", "distance", "sign")]
        rates.append(preparation.samples / total)
        row = " ".join(f"{share:6.0%}" for share in (*shares, 1 - sum(shares)))
        print(f"{name[:34]:34} {len(mesh[1]):7} {rates[-1]:10,.0f} {row}", flush=True)
    if rates:
        low, middle, high = np.min(rates), np.median(rates), np.max(rates)
        print(f"\nsamples a second and core: median {middle:,.0f}, min {low:,.0f}, max {high:,.0f}")
    print(f"prepared {len(rates)}, rejected {rejected.total()}: {dict(rejected)}\n")


def clean_shapes() -> list[Triangles]:
    """Closed shapes: chairs of our own, a ring, procedural chairs."""
    chairs = [refined(Manifold.batch_boolean(chair_parts(seed), OpType.Add)) for seed in range(2)]
    return [*map(triangles, (*chairs, ring())), *(generate("chairs", index) for index in range(3))]


def print_accuracy(samples: int = 20_000) -> None:
    """Mean share of right signs and mean error of the distance, by sign method and breakage."""
    print(f"{'signs right / distance error':28} " + " ".join(f"{name:>22}" for name in BREAKAGES))
    unlimited = Preparation(
        samples=samples, surface_points=0, max_contradictory=1, max_bad_faces=1, min_certain=0
    )
    shapes = clean_shapes()
    for sign in SIGN_METHODS:
        cells = []
        for broken in BREAKAGES.values():
            found = []
            for seed, clean in enumerate(shapes):
                mesh = broken(clean, np.random.default_rng(seed))
                found.append(errors(sampling.prepare_mesh(mesh, replace(unlimited, sign=sign)), clean))
            right, error = np.mean(found, axis=0)
            cells.append(f"{right:.4f} / {error:.5f}")
        print(f"{sign:28} " + " ".join(f"{cell:>22}" for cell in cells), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "folder", nargs="?", type=Path, help="meshes, or `open`; procedural chairs if left out"
    )
    parser.add_argument("--samples", type=int, default=500_000)
    parser.add_argument("--limit", type=int, default=20, help="at most this many meshes")
    args = parser.parse_args()
    print_rates(args.folder, args.limit, Preparation(samples=args.samples))
    print_accuracy()


if __name__ == "__main__":
    main()
