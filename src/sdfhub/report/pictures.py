"""What a page shows of shapes: contact sheets, the best and the worst, and meshes to turn."""

import base64
import io
import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from PIL import Image

from sdfhub.data.workers import stream_in_processes
from sdfhub.geometry.render import render
from sdfhub.report.meshes import FindTruth, ShownMesh, packed, reconstruction, true_mesh
from sdfhub.report.results import ROLES, TABLE_UNIT, Cell, ShapeScore
from sdfhub.report.rows import Group

PIXELS, PAPER = 208, 0.955
"""Side of a picture, and the grey level behind the shape: a tile on a light page and on a dark one."""

FEWEST, MOST = 400, 4000
"""Triangles of a mesh to turn."""

MESH_BYTES, TO_TURN = 4_000_000, 4
"""Room for meshes on a page, and shapes to turn for each group."""

A_WORKERS_WORTH = 32
"""Meshes for which it pays to start a process that draws them."""


@dataclass(frozen=True)
class Tile:
    """A picture [S, S, 3] uint8, None where there is nothing to draw, and the text below or in its place."""

    image: np.ndarray | None
    text: str = ""


@dataclass(frozen=True)
class Sheet:
    """Pictures in rows with labels, under columns with captions."""

    columns: list[str]
    rows: list[tuple[str, list[Tile]]]


class Gallery:
    """Pictures of the shapes of a report, each drawn once.

    Args:
        find_truth: prepared shapes by cell and id.
    """

    def __init__(self, find_truth: FindTruth):
        self.find_truth = find_truth
        self._wanted: dict[tuple, Callable[[], ShownMesh | None]] = {}
        self._images: dict[tuple, np.ndarray | None] = {}

    def sheets(self, groups: list[Group], count: int) -> list[tuple[Sheet, Sheet]]:
        """The contact sheet and the extremes of each group, drawn in as many processes as it is worth.

        Made twice: first without pictures, which says what is to be drawn.
        """
        for _ in range(2):
            sheets = [(self.sheet(group, count), self.extremes(group)) for group in groups]
            left = {key: mesh for key, mesh in self._wanted.items() if key not in self._images}
            workers = min(os.cpu_count() or 1, len(left) // A_WORKERS_WORTH)
            images = stream_in_processes(picture, list(left.values()), workers)
            self._images |= dict(zip(left, images, strict=True))
        return sheets

    def sheet(self, group: Group, count: int) -> Sheet:
        """Truth, then each row of a group, for some shapes: the paper's figures 2 to 6."""
        shown = chosen(group, count)
        cells = [row.first for row in group.rows if row.first]
        rows = [("Ground truth", [self._truth_tile(cells[0], id) for _, id in shown])] if cells else []
        rows = [row for row in rows if any(tile.image is not None for tile in row[1])]
        for row in group.rows:
            absent = Tile(None, "failed" if any(cell.state == "failed" for cell in row.cells) else "missing")
            rows.append(
                (row.label, [self._tile(row.first, *shape) if row.first else absent for shape in shown])
            )
        return Sheet([f"{id} ({role.replace('_', ' ')})" for role, id in shown], rows)

    def extremes(self, group: Group) -> Sheet:
        """Best, median and worst training shape of each row, the truth beside each."""
        rows = []
        for row in group.rows:
            scores = _scores(row.first, "train").values() if row.first else []
            ids = [score.id for score in sorted(scores, key=lambda score: score.excess)]
            for_row = [ids[0], ids[(len(ids) - 1) // 2], ids[-1]] if ids else []
            tiles = [
                (self._truth_tile(row.first, id, id), self._tile(row.first, "train", id)) for id in for_row
            ]
            rows += [(row.label, [tile for pair in tiles for tile in pair])] if tiles else []
        return Sheet(["best: truth", "best", "median: truth", "median", "worst: truth", "worst"], rows)

    def turning(self, groups: list[Group], count: int) -> list[list[dict]]:
        """Some shapes of each group, truth and rows, decimated for the viewer of the page.

        Returns:
            A dict a shape: `name`, `role` and `panels`, its meshes as `packed` with a `label` each.
        """
        return [self._turning(group, min(count, TO_TURN), MESH_BYTES // len(groups)) for group in groups]

    def _turning(self, group: Group, count: int, room: int) -> list[dict]:
        shown, rows = chosen(group, count), [row for row in group.rows if row.first]
        triangles = room // max(1, len(shown) * (len(rows) + 1) * 12)  # some 12 bytes each, as base64
        triangles = min(MOST, max(FEWEST, triangles))
        shapes = []
        for role, id in shown:
            meshes = {"Ground truth": true_mesh(self.find_truth(rows[0].first, id))}
            meshes |= {row.label: self._mesh(row.first, role, id)() for row in rows}
            panels = [{"label": label} | packed(mesh, triangles) for label, mesh in meshes.items() if mesh]
            shapes += [{"name": id, "role": role.replace("_", " "), "panels": panels}] if panels else []
        return shapes

    def _mesh(self, cell: Cell, role: str, id: str) -> Callable[[], ShownMesh | None]:
        """Reads the reconstruction of a shape, in whatever process."""
        score = _scores(cell, role).get(id)
        return partial(reconstruction, cell.folder, role, score, self.find_truth(cell, id))

    def _tile(self, cell: Cell, role: str, id: str) -> Tile:
        score = _scores(cell, role).get(id)
        if score is None or score.failed:
            return Tile(None, "no surface" if score else "not judged")
        image = self._image((cell.folder, role, id), self._mesh(cell, role, id))
        return Tile(image, "no mesh" if image is None else f"CD {score.counted_cd * TABLE_UNIT:.3f}")

    def _truth_tile(self, cell: Cell, id: str, caption: str = "") -> Tile:
        truth = self.find_truth(cell, id)
        image = self._image(("truth", truth.fingerprint), partial(true_mesh, truth)) if truth else None
        return Tile(image, "no truth" if image is None else caption)

    def _image(self, key: tuple, mesh: Callable[[], ShownMesh | None]) -> np.ndarray | None:
        self._wanted[key] = mesh
        return self._images.get(key)


def picture(read_mesh: Callable[[], ShownMesh | None]) -> np.ndarray | None:
    """[S, S, 3] uint8 of a mesh from the usual side; None without one."""
    mesh = read_mesh()
    return render(mesh.vertices, mesh.faces, PIXELS, up=mesh.up, background=PAPER) if mesh else None


def chosen(group: Group, count: int) -> list[tuple[str, str]]:
    """Role and id of the shapes to show: the first training ones, and up to a third held out."""
    cell = next((cell for row in group.rows for cell in row.done), None)
    train, unseen = (list(_scores(cell, role)) if cell else [] for role in ROLES)
    unseen = unseen[: max(count // 3, count - len(train))]
    train = train[: count - len(unseen)]
    return [("train", id) for id in train] + [("held_out", id) for id in unseen]


def _scores(cell: Cell, role: str) -> dict[str, ShapeScore]:
    """The scores of a role by id; {} where shapes have no surfaces to be judged by."""
    return {s.id: s for s in cell.scores.shapes.get(role, []) if isinstance(s, ShapeScore)}


def data_uri(image: np.ndarray) -> str:
    """A picture as a WebP data URI."""
    content = io.BytesIO()
    Image.fromarray(image).save(content, "WEBP", quality=82)
    return "data:image/webp;base64," + base64.b64encode(content.getvalue()).decode()
