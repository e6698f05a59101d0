"""What a page shows of shapes: contact sheets, the best and the worst, and meshes to turn."""

import base64
import io
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from functools import partial

import numpy as np
from PIL import Image

from sdfhub.data.workers import stream_in_processes, workers_worth
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


@dataclass
class Tile:
    """A place of a sheet: a picture, or a text in its place.

    Args:
        text: below the picture.
        instead: in the place of a picture that is not there.
        key: equal where two tiles show one picture.
        read: reads the mesh to draw, in whatever process; None without one.
        image: [S, S, 3] uint8, once drawn.
    """

    text: str = ""
    instead: str = ""
    key: Hashable = None
    read: Callable[[], ShownMesh | None] | None = None
    image: np.ndarray | None = None


@dataclass(frozen=True)
class Sheet:
    """Pictures in rows with labels, under columns with captions."""

    columns: list[str]
    rows: list[tuple[str, list[Tile]]]


@dataclass(frozen=True)
class Gallery:
    """Pictures of the shapes of a report, each drawn once.

    Args:
        find_truth: prepared shapes by cell and id.
    """

    find_truth: FindTruth

    def sheets(self, groups: list[Group], count: int) -> list[tuple[Sheet, Sheet]]:
        """The contact sheet and the extremes of each group, drawn in as many processes as it is worth."""
        pairs = [(self._sheet(group, count), self._extremes(group)) for group in groups]
        tiles = [tile for pair in pairs for sheet in pair for _, row in sheet.rows for tile in row]
        readers = {tile.key: tile.read for tile in tiles if tile.read}
        workers = workers_worth(len(readers), A_WORKERS_WORTH)
        images = dict(zip(readers, stream_in_processes(picture, readers.values(), workers), strict=True))
        for tile in tiles:
            tile.image = images.get(tile.key)
        return pairs

    def _sheet(self, group: Group, count: int) -> Sheet:
        """Truth, then each row of a group, for some shapes: the paper's figures 2 to 6."""
        shown = chosen(group, count)
        cells = [row.first for row in group.rows if row.first]
        truth = [self._truth_tile(cells[0], id) for _, id in shown]
        rows = [("Ground truth", truth)] if any(tile.read for tile in truth) else []
        for row in group.rows:
            absent = "failed" if any(cell.state == "failed" for cell in row.cells) else "missing"
            tiles = [self._tile(row.first, *shape) if row.first else Tile(instead=absent) for shape in shown]
            rows.append((row.label, tiles))
        return Sheet([f"{id} ({role.replace('_', ' ')})" for role, id in shown], rows)

    def _extremes(self, group: Group) -> Sheet:
        """Best, median and worst training shape of each row, the truth beside each."""
        rows = []
        for row in group.rows:
            scores = _scores(row.first, "train").values() if row.first else []
            ids = [score.id for score in sorted(scores, key=lambda score: score.excess)]
            if row.first and ids:
                tiles = []
                for id in (ids[0], ids[(len(ids) - 1) // 2], ids[-1]):
                    tiles += [self._truth_tile(row.first, id, id), self._tile(row.first, "train", id)]
                rows.append((row.label, tiles))
        return Sheet(["best: truth", "best", "median: truth", "median", "worst: truth", "worst"], rows)

    def turning(self, groups: list[Group], count: int) -> list[list[dict]]:
        """Some shapes of each group, truth and rows, decimated for the viewer of the page.

        Returns:
            A dict a shape: `name`, `role` and `panels`, its meshes as `packed` with a `label` each.
        """
        return [self._turning(group, min(count, TO_TURN), MESH_BYTES // len(groups)) for group in groups]

    def _turning(self, group: Group, count: int, room: int) -> list[dict]:
        shown, cells = chosen(group, count), {row.label: row.first for row in group.rows if row.first}
        triangles = room // max(1, len(shown) * (len(cells) + 1) * 12)  # some 12 bytes each, as base64
        triangles = min(MOST, max(FEWEST, triangles))
        shapes = []
        for role, id in shown:
            meshes = {"Ground truth": true_mesh(self.find_truth(next(iter(cells.values())), id))}
            for label, cell in cells.items():
                read = self._tile(cell, role, id).read
                meshes[label] = read() if read else None
            panels = [{"label": label} | packed(mesh, triangles) for label, mesh in meshes.items() if mesh]
            shapes += [{"name": id, "role": role.replace("_", " "), "panels": panels}] if panels else []
        return shapes

    def _tile(self, cell: Cell, role: str, id: str) -> Tile:
        score = _scores(cell, role).get(id)
        if score is None or score.failed:
            return Tile(instead="no surface" if score else "not judged")
        read = partial(reconstruction, cell.folder, role, score, self.find_truth(cell, id))
        return Tile(f"CD {score.counted_cd * TABLE_UNIT:.3f}", "no mesh", (cell.folder, role, id), read)

    def _truth_tile(self, cell: Cell, id: str, caption: str = "") -> Tile:
        truth = self.find_truth(cell, id)
        if truth is None or not truth.rows("faces"):
            return Tile(instead="no truth")
        return Tile(caption, "no truth", truth.fingerprint, partial(true_mesh, truth))


def picture(read_mesh: Callable[[], ShownMesh | None]) -> np.ndarray | None:
    """[S, S, 3] uint8 of a mesh from the usual side; None without one."""
    mesh = read_mesh()
    return render(mesh.vertices, mesh.faces, PIXELS, up=mesh.up, background=PAPER) if mesh else None


def chosen(group: Group, count: int) -> list[tuple[str, str]]:
    """Role and id of the shapes to show: the first training ones, and up to a third held out."""
    cell = next((cell for row in group.rows for cell in row.done), None)
    train, held_out = (list(_scores(cell, role)) if cell else [] for role in ROLES)
    held_out = held_out[: max(count // 3, count - len(train))]
    train = train[: count - len(held_out)]
    return [("train", id) for id in train] + [("held_out", id) for id in held_out]


def _scores(cell: Cell, role: str) -> dict[str, ShapeScore]:
    """The scores of a role by id; {} where shapes have no surfaces to be judged by."""
    return {s.id: s for s in cell.result.shapes.get(role, []) if isinstance(s, ShapeScore)}


def data_uri(image: np.ndarray) -> str:
    """A picture as a WebP data URI."""
    content = io.BytesIO()
    Image.fromarray(image).save(content, "WEBP", quality=82)
    return "data:image/webp;base64," + base64.b64encode(content.getvalue()).decode()
