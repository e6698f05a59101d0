"""Seconds to make 100 procedural shapes of each category, on one core where the system can pin a process.

python benchmarks/procedural.py [--shapes 100]
"""

import argparse
import os
import time

import numpy as np

from sdfhub.procedural import CATEGORIES, generate


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--shapes", type=int, default=100)
    args = parser.parse_args()
    if hasattr(os, "sched_setaffinity"):  # booleans use every core they are given
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    print(f"{args.shapes} shapes: seconds, and the least, median and most faces")
    for category in CATEGORIES:
        start = time.perf_counter()
        counts = [len(generate(category, index)[1]) for index in range(args.shapes)]
        seconds = time.perf_counter() - start
        print(f"{category:10} {seconds:7.2f} {min(counts):7} {int(np.median(counts)):7} {max(counts):7}")


if __name__ == "__main__":
    main()
