"""Judging reconstructions: shapes a minute, and what a thousand take.

    python benchmarks/evaluation.py [--chamfer 1000] [--judged 60] [--space RUN --resolutions 128 256]

Truth: procedural chairs. In the place of a reconstruction: the same chair with each face split until there
are some 100,000, its vertices moved by noise of 0.002. Three things are timed: the Chamfer distance alone
(sampling both sides and comparing), on --chamfer chairs, one process; all metrics of `judge`, on --judged of
them, in this process and in one worker a core; and, given a trained space, `sdfhub evaluate` on its first
known shapes, meshing included. What is not run on 1000 shapes is extrapolated, and says so. Peak memory: of
this process so far, or of its largest child.
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
from runs import ROOT, at_least, run_benchmark

from sdfhub.data.preparation.normalize import normalize_mesh
from sdfhub.data.preparation.settings import DEFAULT
from sdfhub.data.workers import stream_in_processes
from sdfhub.geometry.metrics import Judge, chamfer
from sdfhub.geometry.surface_sampling import sample_surface
from sdfhub.procedural import generate
from sdfhub.shapes import Mesh, NormalizedMesh
from sdfhub.tasks.run import read_run

FACES = 50_000
"""A twin is split until it has more."""


def pairs(count: int) -> Iterator[tuple[Mesh, NormalizedMesh]]:
    for index in range(count):
        truth = normalize_mesh(*generate("chairs", index), DEFAULT)
        vertices, faces = truth.vertices, truth.faces
        while len(faces) < FACES:
            vertices, faces = trimesh.remesh.subdivide(vertices, faces)
        noise = np.random.default_rng(index).normal(scale=0.002, size=vertices.shape)
        yield (vertices + noise, faces), truth


def time_chamfer(count: int) -> None:
    spent, processor, faces = 0.0, 0.0, []
    for mesh, truth in pairs(count):
        start, at = time.perf_counter(), time.process_time()
        have, _ = sample_surface(*mesh, 30_000, (0, 2))
        want, _ = sample_surface(truth.vertices, truth.faces, 30_000, (0, 0))
        chamfer(have, want)
        spent, processor = spent + time.perf_counter() - start, processor + time.process_time() - at
        faces.append(len(mesh[1]))
    line(f"Chamfer alone, 1 process, {np.median(faces):.0f} faces", count, spent, processor)


def time_judge(count: int) -> None:
    ready = list(pairs(count))
    for workers in (0, os.cpu_count()):
        stream = stream_in_processes(Judge(30_000, 0), ready, workers)
        next(stream)  # processes have started
        start, at = time.perf_counter(), time.process_time()
        judged = len(list(stream))
        spent, processor = time.perf_counter() - start, time.process_time() - at
        where = f"{workers} worker processes" if workers else "1 process"
        line(f"all metrics, {where}", judged, spent, None if workers else processor)


def time_evaluation(space: Path, resolution: int, shapes: int) -> None:
    command = [sys.executable, "-m", "sdfhub", "evaluate", f"run={space}"]
    with tempfile.TemporaryDirectory() as out:
        command += [f"evaluate.resolution={resolution}", f"evaluate.train={shapes}"]
        command += ["evaluate.held_out=0", f"out={out}"]
        start = time.perf_counter()
        subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
        line(f"sdfhub evaluate at {resolution}^3, start included", shapes, time.perf_counter() - start)


def line(name: str, shapes: int, seconds: float, processor: float | None = None) -> None:
    kind = "run" if shapes >= 1000 else "extrapolated"
    peak = max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    cells = [
        name,
        shapes,
        f"{seconds:.1f}",
        "" if processor is None else f"{processor:.1f}",
        f"{60 * shapes / seconds:.0f}",
    ]
    cells += [f"{1000 / shapes * seconds / 60:.1f} ({kind})", f"{peak / 2**20:.2f}"]
    print("| " + " | ".join(map(str, cells)) + " |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--chamfer", type=at_least(1), default=1000, help="chairs for the Chamfer distance alone"
    )
    parser.add_argument("--judged", type=at_least(2), default=60, help="chairs for all metrics")
    parser.add_argument("--space", type=Path, help="folder of a trained run")
    parser.add_argument("--resolutions", type=at_least(2), nargs="+", default=[128, 256])
    parser.add_argument("--known", type=at_least(1), default=16, help="shapes of the space to evaluate")
    arguments = parser.parse_args()
    if arguments.space:
        read_run(arguments.space.resolve())  # a wrong folder is told before minutes of measuring
    print("| what | shapes | seconds | of a processor | shapes a minute | minutes for 1000 | peak GiB |")
    print("| --- " * 7 + "|")
    time_chamfer(arguments.chamfer)
    time_judge(arguments.judged)
    for resolution in arguments.resolutions if arguments.space else ():
        time_evaluation(arguments.space.resolve(), resolution, arguments.known)


if __name__ == "__main__":
    run_benchmark(main)
