"""How many shapes between two known ones are in one piece.

    python benchmarks/interpolation.py outputs/.../RUN [--pairs 50] [--sheet FILE.png]

Draws pairs of known shapes that are in one piece themselves, and meshes the codes a quarter, half and three
quarters of the way. `--sheet` draws the first eight pairs, a row each.
"""

import argparse
from pathlib import Path

import numpy as np
from PIL import Image
from runs import head, row

import sdfhub
from sdfhub.geometry.render import render
from sdfhub.triangles import piece_count

STEPS = ("known", "1/4", "1/2", "3/4", "known")
ROWS = 8  # of the sheet


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", help="folder of a trained run, or an exported space")
    parser.add_argument("--pairs", type=int, default=50)
    parser.add_argument("--resolution", type=int, default=192)
    parser.add_argument("--sheet", type=Path)
    arguments = parser.parse_args()
    space = sdfhub.load(arguments.run)
    rng = np.random.default_rng(0)
    pieces, pictures, skipped = [], [], 0
    while len(pieces) < arguments.pairs and skipped < len(space.ids):
        pair = rng.choice(len(space.ids), 2, replace=False).tolist()
        meshes = list(space.meshes(space.interpolate(*pair, steps=5), arguments.resolution))
        counts = [piece_count(faces, len(vertices)) for vertices, faces in meshes]
        if counts[0] != 1 or counts[-1] != 1:
            skipped += 1
            continue
        pieces.append(counts)
        if arguments.sheet and len(pictures) < ROWS:
            pictures.append(np.hstack([render(*mesh, 200, up=space.up) for mesh in meshes]))
    if not pieces:
        raise SystemExit(
            f"sdfhub: error: {arguments.run}: no two known shapes in one piece in {skipped} pairs"
        )
    print(f"{arguments.run}: {len(pieces)} pairs of known shapes in one piece; {skipped} pairs passed over")
    head("way | in one piece | pieces, mean")
    for step, counts in list(zip(STEPS, np.transpose(pieces), strict=True))[1:-1]:
        row(step, f"{np.mean(counts == 1):.0%}", f"{np.mean(counts):.2f}")
    if arguments.sheet:
        Image.fromarray(np.vstack(pictures)).save(arguments.sheet)


if __name__ == "__main__":
    main()
