"""Judging reconstructions: shapes a minute, and what a thousand take.

    python benchmarks/evaluation.py [--chamfer 1000] [--judged 60] [--space RUN --resolutions 128 256]

Truth: procedural chairs. In the place of a reconstruction: the same chair with each face split until there
are some 100,000, its vertices moved by noise of 0.002. Three things are timed: the Chamfer distance alone
(sampling both sides and comparing), on --chamfer chairs, one process; all metrics of `judge`, on --judged of
them, in this process and in one worker a core; and, given a trained space, `sdfhub evaluate` on its first
training shapes, meshing included. What is not run on 1000 shapes is extrapolated, and says so. Peak memory:
of this process so far, or of its largest child.
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import trimesh
from runs import ROOT, head, row

from sdfhub.data.preparation.sampling import normalize_mesh
from sdfhub.data.workers import map_in_processes
from sdfhub.geometry.metrics import chamfer, judge
from sdfhub.geometry.surface import sample_surface
from sdfhub.procedural import generate
from sdfhub.shapes import Mesh, NormalizedMesh

FACES = 50_000
"""A twin is split until it has more."""


def pairs(count: int) -> Iterator[tuple[Mesh, NormalizedMesh]]:
    for index in range(count):
        truth = normalize_mesh(*generate("chairs", index))
        vertices, faces = truth.vertices, truth.faces
        while len(faces) < FACES:
            vertices, faces = trimesh.remesh.subdivide(vertices, faces)
        noise = np.random.default_rng(index).normal(scale=0.002, size=vertices.shape)
        yield Mesh(vertices + noise, faces), truth


def time_chamfer(count: int) -> None:
    spent, processor, faces = 0.0, 0.0, []
    for mesh, truth in pairs(count):
        start, at = time.perf_counter(), time.process_time()
        have, _ = sample_surface(*mesh, 30_000, (0, 2))
        want, _ = sample_surface(truth.vertices, truth.faces, 30_000, (0, 0))
        chamfer(have, want)
        spent, processor = spent + time.perf_counter() - start, processor + time.process_time() - at
        faces.append(len(mesh.faces))
    line(f"Chamfer alone, 1 process, {np.median(faces):.0f} faces", count, spent, f"{processor:.1f}")


def time_judge(count: int) -> None:
    ready = list(pairs(count))
    for workers in (0, os.cpu_count()):
        stream = map_in_processes(lambda pair: judge(*pair), ready, workers)
        next(stream)  # processes have started
        start, at = time.perf_counter(), time.process_time()
        judged = len(list(stream))
        spent, processor = time.perf_counter() - start, time.process_time() - at
        where = f"{workers} worker processes" if workers else "1 process"
        line(f"all metrics, {where}", judged, spent, "" if workers else f"{processor:.1f}")


def time_evaluation(space: Path, resolution: int, shapes: int) -> None:
    command = [sys.executable, "-m", "sdfhub", "evaluate", f"run={space}", "evaluate.held_out=0"]
    command += [f"evaluate.resolution={resolution}", f"evaluate.train={shapes}"]
    with tempfile.TemporaryDirectory() as out:
        start = time.perf_counter()
        subprocess.run([*command, f"out={out}"], cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
        line(f"sdfhub evaluate at {resolution}^3, start included", shapes, time.perf_counter() - start)


def line(name: str, shapes: int, seconds: float, processor: str = "") -> None:
    kind = "run" if shapes >= 1000 else "extrapolated"
    peak = max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    thousand = f"{1000 / shapes * seconds / 60:.1f} ({kind})"
    cells = f"{seconds:.1f}", processor, f"{60 * shapes / seconds:.0f}", thousand, f"{peak / 2**20:.2f}"
    row(name, shapes, *cells)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--chamfer", type=int, default=1000, help="chairs for the Chamfer distance alone")
    parser.add_argument("--judged", type=int, default=60, help="chairs for all metrics, at least 2")
    parser.add_argument("--space", type=Path, help="folder of a trained run")
    parser.add_argument("--resolutions", type=int, nargs="+", default=[128, 256])
    parser.add_argument("--shapes", type=int, default=16, help="training shapes of the space to evaluate")
    arguments = parser.parse_args()
    head("what | shapes | seconds | of a processor | shapes a minute | minutes for 1000 | peak GiB")
    time_chamfer(arguments.chamfer)
    time_judge(arguments.judged)
    for resolution in arguments.resolutions if arguments.space else ():
        time_evaluation(arguments.space.resolve(), resolution, arguments.shapes)


if __name__ == "__main__":
    main()
