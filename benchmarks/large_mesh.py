"""Preparation of one mesh of two million faces: seconds and peak memory.

Run: python benchmarks/large_mesh.py [--hidden] [--samples 500000]

A sphere with bumps, its faces turned at random so that no fast path applies; with --hidden most of the faces
lie inside another, coarse sphere and are seen by no view.
"""

import argparse
import os
import resource
import time

for name in ("OMP_NUM_THREADS", "IGL_NUM_THREADS"):
    os.environ[name] = "1"

import numpy as np  # noqa: E402
from runs import head, row  # noqa: E402

from sdfhub.data.preparation.sampling import Preparation, prepare_mesh  # noqa: E402

SIDE = 1000
"""Rings and meridians of the sphere: twice its square are its faces."""


def bumpy_sphere(side: int = SIDE, radius: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a closed sphere with bumps, each face turned at random."""
    polar, turn = np.meshgrid(
        np.linspace(1e-3, np.pi - 1e-3, side), np.linspace(0, 2 * np.pi, side), indexing="ij"
    )
    height = radius * (1 + 0.05 * np.sin(9 * polar) * np.sin(8 * turn))
    sine = np.sin(polar)
    vertices = height[..., None] * np.stack([sine * np.cos(turn), sine * np.sin(turn), np.cos(polar)], -1)
    grid = np.arange(side * side).reshape(side, side)
    a, b, c, d = (g.ravel() for g in (grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    turned = np.random.default_rng(0).random(len(faces)) < 0.5
    faces[turned] = faces[turned, ::-1]
    return vertices.reshape(-1, 3), faces


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--hidden", action="store_true", help="put the faces where no view sees them")
    parser.add_argument("--samples", type=int, default=500_000)
    args = parser.parse_args()
    vertices, faces = bumpy_sphere()
    if args.hidden:
        more, shell = bumpy_sphere(40, 1.3)
        vertices, faces = np.concatenate([vertices, more]), np.concatenate([faces, shell + len(vertices)])
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    start = time.process_time()
    samples = prepare_mesh((vertices, faces), Preparation(samples=args.samples))
    seconds = time.process_time() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    head("faces | kept | s of processor | samples/s | peak GB | before preparing GB")
    counts = f"{len(faces):,}", f"{len(samples.mesh.faces):,}"
    speed = f"{seconds:.0f}", f"{args.samples / seconds:,.0f}"
    row(*counts, *speed, f"{peak / 2**20:.2f}", f"{memory / 2**20:.2f}")


if __name__ == "__main__":
    main()
