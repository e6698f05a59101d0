"""How soon a shape of a run appears in `sdfhub view`: from what a control says to its mesh.

    python benchmarks/viewing.py outputs/.../RUN [shapes]

Prints a Markdown table of milliseconds at the resolutions that the page goes through, medians over shapes.
Transfer to the browser (loopback) and drawing come on top.
"""

import argparse
import queue
import statistics

from runs import head, row

import sdfhub
from sdfhub.viewer.live_meshing import LiveMesher, Meshed

RESOLUTIONS = (64, 128, 192, 256)


def milliseconds(space: sdfhub.Space, resolution: int, shapes: int) -> float:
    """The median time until the mesh of a shape, compilers warmed up by one before."""
    shown: queue.Queue[Meshed] = queue.Queue()
    mesher = LiveMesher(space.decoder, [resolution], shown.put)
    found = []
    for index in range(shapes + 1):
        mesher.ask(space.code(index % len(space.ids)))
        found.append(shown.get().seconds)
    mesher.close()
    return 1e3 * statistics.median(found[1:])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", help="folder of a trained run")
    parser.add_argument("shapes", nargs="?", type=int, default=8)
    arguments = parser.parse_args()
    space = sdfhub.load(arguments.run)
    weights = sum(weight.numel() for weight in space.decoder.parameters())
    print(f"{arguments.run}: {weights:,} weights, on {space.device}")
    head("grid | ms")
    for resolution in RESOLUTIONS:
        row(f"{resolution}^3", f"{milliseconds(space, resolution, arguments.shapes):.0f}")


if __name__ == "__main__":
    main()
