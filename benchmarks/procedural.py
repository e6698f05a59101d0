"""Seconds to make 100 procedural shapes of each category, on one core where the system can pin a process.

    python benchmarks/procedural.py [--shapes 100] [--sheet FOLDER]

With --sheet it also draws a contact sheet of the first 24 shapes of each category.
"""

import argparse
import os
import time
from pathlib import Path

import numpy as np
from runs import at_least, run_benchmark

from sdfhub.geometry.contact_sheet import contact_sheet
from sdfhub.geometry.render import render
from sdfhub.procedural import CATEGORIES, generate
from sdfhub.shapes import RADIUS


def picture(category: str, index: int) -> np.ndarray:
    vertices, faces = generate(category, index)
    vertices = vertices - (vertices.min(0) + vertices.max(0)) / 2
    return render(vertices * RADIUS / np.linalg.norm(vertices, axis=1).max(), faces, 256)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--shapes", type=at_least(1), default=100)
    parser.add_argument("--sheet", type=Path, help="folder for contact sheets")
    args = parser.parse_args()
    if hasattr(os, "sched_setaffinity"):  # booleans use every core they are given
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    print(f"{args.shapes} shapes: seconds, and the least, median and most faces")
    for category in CATEGORIES:
        start = time.perf_counter()
        counts = [len(generate(category, index)[1]) for index in range(args.shapes)]
        seconds = time.perf_counter() - start
        print(f"{category:10} {seconds:7.2f} {min(counts):7} {int(np.median(counts)):7} {max(counts):7}")
        if args.sheet:
            pictures = [picture(category, index) for index in range(24)]
            rows = [pictures[k : k + 6] for k in range(0, 24, 6)]
            print(contact_sheet(rows, [f"{k}" for k in range(0, 24, 6)], [], args.sheet / f"{category}.png"))


if __name__ == "__main__":
    run_benchmark(main)
