"""Preparation: how fast one core makes signed samples of a mesh, and how many signs are right on broken ones.

Run: python benchmarks/preparation.py [open] [--samples 500000] [--limit 8 | --all] [--workers]

`open` stands for the furniture of data=open (`make data` fetches it), evenly over its categories. Without it
the meshes are procedural chairs, each also with half its faces turned, so that both paths are timed.
Time is that of the processor, from the mesh file's bytes to samples in memory; writing them is not in it.
Beside the stages' shares stand the rates of the libraries alone on the same work: embree on the last rays of
the mesh as they came and shuffled, libigl's distances on 50,000 of the samples in Morton order; and the share
of these rates that preparation reaches, all its own work on rays and distances counted.
`--workers` prepares the meshes by one and by two processes instead, and prints the ratio of the rounds.
The second table breaks closed shapes in known ways and compares the rival sign methods with the truth of the
clean twin.
"""

import argparse
import os
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from functools import partial

for name in ("OMP_NUM_THREADS", "IGL_NUM_THREADS"):  # a rate per core needs one thread
    os.environ[name] = "1"

import igl  # noqa: E402
import numpy as np  # noqa: E402
from embreex.rtcore_scene import EmbreeScene  # noqa: E402
from manifold3d import Manifold, OpType  # noqa: E402
from runs import ROOT, head, row  # noqa: E402

sys.path.insert(0, str(ROOT))

from sdfhub.data.preparation import sampling, visibility  # noqa: E402
from sdfhub.data.preparation.sampling import Preparation  # noqa: E402
from sdfhub.data.preparation.signs import SIGN_METHODS  # noqa: E402
from sdfhub.data.sources import OpenSource  # noqa: E402
from sdfhub.data.workers import map_in_processes  # noqa: E402
from sdfhub.errors import RejectedMesh  # noqa: E402
from sdfhub.geometry.morton import morton_order  # noqa: E402
from sdfhub.procedural import generate  # noqa: E402
from sdfhub.shapes import Mesh, ShapeSamples  # noqa: E402
from tests.broken_twins import BREAKAGES, chair_parts, errors, flipped, refined, ring, triangles  # noqa: E402
from tests.categories import CATEGORIES  # noqa: E402

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


class CountedScene(EmbreeScene):
    """Counts the rays of preparation and keeps the last of them."""

    rays = 0
    last: tuple = ()

    def run(self, origins, directions, **options):
        CountedScene.rays += len(origins)
        CountedScene.last = self, origins, directions, options
        return super().run(origins, directions, **options)


visibility.EmbreeScene = CountedScene


def rate(function: Callable, count: int, rounds: int = 3) -> float:
    """The best of some rounds' items a processor second."""
    seconds = []
    for _ in range(rounds):
        start = time.process_time()
        function()
        seconds.append(time.process_time() - start)
    return count / max(min(seconds), 1e-9)


def raw_rates(samples: ShapeSamples) -> tuple[float, float, float]:
    """Rays a second of embree alone, in order and shuffled, and distances a second of libigl alone."""
    in_order = shuffled = float("nan")
    if CountedScene.last:
        scene, origins, directions, options = CountedScene.last
        order = np.random.default_rng(0).permutation(len(origins))
        mixed = origins[order], directions[order]
        in_order = rate(lambda: EmbreeScene.run(scene, origins, directions, **options), len(origins))
        shuffled = rate(lambda: EmbreeScene.run(scene, *mixed, **options), len(origins))
    points = samples.points[:50_000].astype(np.float64)
    points, tree = points[morton_order(points)], igl.AABB()
    tree.init(samples.mesh.vertices, samples.mesh.faces)
    query = (samples.mesh.vertices, samples.mesh.faces, points)
    return in_order, shuffled, rate(lambda: tree.squared_distance(*query), len(points))


Loader = Callable[[], Mesh]


def furniture() -> OpenSource:
    return OpenSource({name: rule for name, rule in CATEGORIES.items() if name != "planes"})


def evenly(shapes: list, limit: int) -> list:
    return shapes[:: max(1, len(shapes) // limit)][:limit]


def meshes(open: str | None, limit: int) -> Iterator[tuple[str, Loader]]:
    """Names and loaders of the open furniture, or of procedural chairs whole and half turned."""
    if open:
        source = furniture()
        yield from ((shape.id, partial(source.load, shape)) for shape in evenly(source.shapes(), limit))
        return
    for index in range(limit):
        chair = generate("chairs", index)
        yield f"chair {index}", lambda chair=chair: chair
        yield f"chair {index}, half turned", lambda c=chair, i=index: flipped(c, np.random.default_rng(i))


COLUMNS = (
    "mesh | faces | samples/s | load | rays | dist. | sign | rest | rays cast | M rays/s embree | shuffled |"
    " of it | M dist./s libigl | of it"
)


def print_rates(open: str | None, limit: int, preparation: Preparation) -> None:
    """Samples a second and core, the stages' shares of the time, the libraries' own rates, rejections."""
    watch, rates, rejected = Stopwatch(), [], Counter()
    head(COLUMNS)
    for name, load in meshes(open, limit):
        watch.seconds.clear()
        CountedScene.rays, CountedScene.last = 0, ()
        start = time.process_time()
        mesh = load()
        watch.seconds["load"] = time.process_time() - start
        try:
            samples = sampling.prepare_mesh(mesh, preparation)
        except RejectedMesh as error:
            rejected[error.reason] += 1
            continue
        total = time.process_time() - start
        rates.append(preparation.samples / total)
        row(name, len(mesh[1]), f"{rates[-1]:,.0f}", *_shares(watch.seconds, total, samples))
    if rates:
        low, middle, high = np.min(rates), np.median(rates), np.max(rates)
        slow = sum(rate < 80_000 for rate in rates)
        print(f"\nsamples a second and core: median {middle:,.0f}, min {low:,.0f}, max {high:,.0f}")
        print(f"below 80,000: {slow} of {len(rates)}")
    print(f"prepared {len(rates)}, rejected {rejected.total()}: {dict(rejected)}\n")


def _shares(seconds: dict[str, float], total: float, samples: ShapeSamples) -> list[str]:
    shares = [seconds[stage] / total for stage in ("load", "rays", "distance", "sign")]
    in_order, shuffled, distances = raw_rates(samples)
    cells = [f"{share:.0%}" for share in (*shares, 1 - sum(shares))]
    if CountedScene.rays:
        cells += [f"{CountedScene.rays:,}", f"{in_order / 1e6:.1f}", f"{shuffled / 1e6:.1f}"]
        cells += [f"{CountedScene.rays / seconds['rays'] / in_order:.0%}"]
    else:  # a clean closed mesh needs none
        cells += ["0", "", "", ""]
    reached = len(samples.points) / seconds["distance"] / distances
    return [*cells, f"{distances / 1e6:.2f}", f"{reached:.0%}"]


class Prepare:
    """Prepares a procedural chair, or a shape of data=open; pickles into worker processes."""

    def __init__(self, preparation: Preparation, source: OpenSource | None):
        self.preparation, self.source = preparation, source

    def __call__(self, shape) -> float:
        """The processor's seconds."""
        start = time.process_time()
        mesh = self.source.load(shape) if self.source else generate("chairs", shape)
        with suppress(RejectedMesh):
            sampling.prepare_mesh(mesh, self.preparation)
        return time.process_time() - start


def print_scaling(open: str | None, limit: int, preparation: Preparation, rounds: int = 2) -> None:
    """Seconds for the same meshes by one and by two worker processes, their start included.

    Where other work takes the cores, the ratio of the processor's seconds tells what two processes cost each
    other: 1.00 is linear.
    """
    source = furniture() if open else None
    shapes = evenly(source.shapes(), limit) if source else list(range(limit))
    prepare = Prepare(preparation, source)
    print(f"{len(shapes)} meshes")
    head("s with 1 process | with 2 | ratio | processor s with 1 | with 2 | ratio")
    for _ in range(rounds):
        wall, busy = [], []
        for workers in (1, 2):
            start = time.perf_counter()
            busy.append(sum(seconds for _, seconds in map_in_processes(prepare, shapes, workers)))
            wall.append(time.perf_counter() - start)
        row(*(f"{one:.1f} | {two:.1f} | {one / two:.2f}" for one, two in (wall, busy)))


def clean_shapes() -> list[Mesh]:
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
    parser.add_argument("source", nargs="?", choices=["open"], help="else procedural chairs")
    parser.add_argument("--samples", type=int, default=500_000)
    parser.add_argument("--limit", type=int, default=8, help="at most this many meshes")
    parser.add_argument("--all", action="store_true", help="every mesh")
    parser.add_argument("--workers", action="store_true", help="one and two processes instead")
    args = parser.parse_args()
    limit = 10**9 if args.all else args.limit
    if args.workers:
        return print_scaling(args.source, limit, Preparation(samples=args.samples))
    print_rates(args.source, limit, Preparation(samples=args.samples))
    print_accuracy()


if __name__ == "__main__":
    main()
