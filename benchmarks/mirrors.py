"""Whether what is wrong about training shapes is their mirror image: not all of a symmetric family are.

    python benchmarks/mirrors.py RUN ...

Per run, shapes by their excess (times 10^3), and by how much their surface differs from its own mirror image
across either vertical plane (CD times 10^3). Strays: samples of the reconstruction further than 0.05 from the
true surface; beside their share, the share of them that lies within 0.05 of the mirrored truth, across the
plane that explains more. Last the rank correlation of excess and asymmetry across each plane.
"""

import argparse
from pathlib import Path

import numpy as np
from runs import head, row
from scipy.spatial import cKDTree
from scipy.stats import spearmanr

from sdfhub.geometry.surface import sample_surface
from sdfhub.report.pictures import reconstruction
from sdfhub.report.results import Cell, PlannedCell, ShapeScore, read_scores
from sdfhub.tasks.report import truth_finder

POINTS, FAR = 10_000, 0.05


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="+", type=Path)
    truth = truth_finder()
    for run in map(Path.resolve, parser.parse_args().runs):
        plan = PlannedCell(folder=run.name, choices={}, settings={}, seed=0)
        cell = Cell(plan, run, "done", "", read_scores(run))
        found = [found for score in cell.scores.shapes["train"] if (found := judged(cell, score, truth))]
        found.sort(key=lambda shape: -shape[1])
        print(f"\n### {run.name}")
        head("shape | excess | differs across x | across the other | strays | of these mirrored")
        for id, excess, across, other, strays, mirrored in found:
            of_these = f"{mirrored:.2f}" if strays else ""
            row(id, f"{excess:.4f}", f"{across:.2f}", f"{other:.2f}", f"{strays:.3f}", of_these)
        excesses, *columns = np.array([shape[1:4] for shape in found]).T
        ranks = [spearmanr(excesses, column).statistic for column in columns]
        print(f"\nrank correlation of excess: across x {ranks[0]:.2f}, across the other {ranks[1]:.2f}")


def judged(cell: Cell, score: ShapeScore, truth) -> tuple | None:
    """Id, excess, two asymmetries, strays, share of these in the mirror; None without truth or mesh."""
    shape = truth(cell, score.id)
    mesh = reconstruction(cell.folder, "train", score, shape) if shape else None
    if mesh is None:
        return None
    surface = np.array(shape.read("surface")[:POINTS, :3])
    tree = cKDTree(surface)
    mirrors = [surface * np.where(np.arange(3) == axis, -1, 1) for axis in (0, 1 if shape.up == "z" else 2)]
    asymmetries = [2e3 * (tree.query(mirror)[0] ** 2).mean() for mirror in mirrors]  # both ways alike
    points, _ = sample_surface(mesh.vertices, mesh.faces, POINTS, seed=0)
    strays = points[tree.query(points)[0] > FAR]
    explained = [np.mean(cKDTree(m).query(strays)[0] < FAR) if len(strays) else 0.0 for m in mirrors]
    return score.id, score.excess * 1e3, *asymmetries, len(strays) / len(points), max(explained)


if __name__ == "__main__":
    main()
