"""What a page shows of shapes: contact sheets, the best and the worst, and meshes to turn."""

import base64
import io
from dataclasses import dataclass, field

import fast_simplification
import numpy as np
from PIL import Image

from sdfhub.geometry.render import render
from sdfhub.report.meshes import FindTruth, Mesh, reconstruction, true_mesh
from sdfhub.report.results import ROLES, ShapeScore
from sdfhub.report.rows import Group, Row

PIXELS, PAPER = 208, 0.955
"""Side of a picture, and the grey level behind the shape: a tile on a light page and on a dark one."""

FEWEST, MOST = 400, 4000
"""Triangles of a mesh to turn."""


@dataclass(frozen=True)
class Tile:
    """One picture.

    Args:
        image: [S, S, 3] uint8; None where there is no surface or no file.
        caption: below it.
        alt: what stands in the place of a picture that is not there.
    """

    image: np.ndarray | None
    caption: str
    alt: str


@dataclass(frozen=True)
class Sheet:
    """Pictures in rows with labels, under columns with captions."""

    columns: list[str]
    rows: list[tuple[str, list[Tile]]]


@dataclass
class Gallery:
    """Renders and packs meshes, each once.

    Args:
        find_truth: prepared shapes by cell and id.
    """

    find_truth: FindTruth
    _images: dict[tuple, np.ndarray | None] = field(default_factory=dict)

    def sheet(self, group: Group, count: int) -> Sheet:
        """Truth, then each row of a group, for some shapes: the paper's figures 2 to 6."""
        shown = chosen(group, count)
        columns = [f"{id} ({'known' if role == 'known' else 'held out'})" for role, id in shown]
        first = _first_done(group)
        truth = [Tile(self._truth_image(first, id), "", "no truth") for _, id in shown]
        rows = [("Ground truth", truth)] if any(tile.image is not None for tile in truth) else []
        for row in group.rows:
            absent = Tile(
                None, "", "failed" if any(cell.state == "failed" for cell in row.cells) else "missing"
            )
            tiles = [self._tile(row, role, id) if row.done else absent for role, id in shown]
            rows.append((row.label, tiles))
        return Sheet(columns, rows)

    def extremes(self, group: Group) -> Sheet:
        """Best, median and worst known shape of each row, the truth beside each."""
        names = ("best", "median", "worst")
        columns = [text for name in names for text in (f"{name}: truth", name)]
        rows = []
        for row in group.rows:
            shapes = row.done[0].scores.shapes.get("known", []) if row.done else []
            if shapes:
                ranked = sorted(shapes, key=lambda shape: shape.excess)
                picked = (ranked[0], ranked[(len(ranked) - 1) // 2], ranked[-1])
                tiles = [tile for shape in picked for tile in self._pair(row, shape)]
                rows.append((row.label, tiles))
        return Sheet(columns, rows)

    def turning(self, group: Group, count: int, budget: int) -> list[dict]:
        """Decimated meshes of some shapes, truth and rows, packed for the viewer of the page.

        Args:
            group: whose.
            count: shapes at most.
            budget: bytes for all of them.
        """
        shown = chosen(group, count)
        rows = [row for row in group.rows if row.done]
        triangles = budget // max(1, len(shown) * (len(rows) + 1) * 12)  # some 12 bytes each, as base64
        triangles = min(MOST, max(FEWEST, triangles))
        found = []
        for role, id in shown:
            meshes = [("Ground truth", true_mesh(self.find_truth(rows[0].done[0], id)))]
            meshes += [(row.label, self._mesh(row, role, id)) for row in rows]
            panels = [{"label": label} | packed(mesh, triangles) for label, mesh in meshes if mesh]
            if panels:
                found.append({"name": id, "role": role.replace("_", " "), "panels": panels})
        return found

    def _pair(self, row: Row, shape: ShapeScore) -> list[Tile]:
        truth = Tile(self._truth_image(row, shape.id), shape.id, "no truth")
        return [truth, self._tile(row, "known", shape.id)]

    def _tile(self, row: Row, role: str, id: str) -> Tile:
        score = _score(row, role, id)
        if score is None:
            return Tile(None, "", "not judged")
        key = (row.done[0].folder, role, id)
        if key not in self._images:
            self._images[key] = picture(self._mesh(row, role, id))
        caption = "no surface" if score.failed else f"CD {score.counted_cd * 1e3:.3f}"
        return Tile(self._images[key], caption, "no surface" if score.failed else "no mesh")

    def _truth_image(self, row: Row, id: str) -> np.ndarray | None:
        truth = self.find_truth(row.done[0], id)
        key = truth and ("truth", truth.folder)
        if key not in self._images:
            self._images[key] = picture(true_mesh(truth))
        return self._images[key]

    def _mesh(self, row: Row, role: str, id: str) -> Mesh | None:
        score = _score(row, role, id)
        return reconstruction(row.done[0], role, score, self.find_truth(row.done[0], id)) if score else None


def _score(row: Row, role: str, id: str) -> ShapeScore | None:
    """The score in the row's first finished seed."""
    return next((score for score in row.done[0].scores.shapes.get(role, []) if score.id == id), None)


def _first_done(group: Group) -> Row | None:
    return next((row for row in group.rows if row.done), None)


def chosen(group: Group, count: int) -> list[tuple[str, str]]:
    """Role and id of the shapes to show: known ones, and up to a third held out, from the front of each."""
    row = _first_done(group)
    if row is None:
        return []
    known, unseen = ([shape.id for shape in row.done[0].scores.shapes.get(role, [])] for role in ROLES)
    unseen = unseen[: max(count // 3, count - len(known))]
    known = known[: count - len(unseen)]
    return [("known", id) for id in known] + [("held_out", id) for id in unseen]


def picture(mesh: Mesh | None) -> np.ndarray | None:
    """A mesh from the usual side, [S, S, 3] uint8; None without a mesh."""
    return mesh and render(mesh.vertices, mesh.faces, PIXELS, up=mesh.up, background=PAPER)


def data_uri(image: np.ndarray) -> str:
    """A picture as a WebP data URI."""
    content = io.BytesIO()
    Image.fromarray(image).save(content, "WEBP", quality=82)
    return "data:image/webp;base64," + base64.b64encode(content.getvalue()).decode()


def packed(mesh: Mesh, triangles: int) -> dict[str, int | str]:
    """A mesh of at most about `triangles`, +z up, as little-endian 16-bit integers in base64.

    Returns:
        `vertices` and `faces`: counts; `data`: positions times 32767 (int16), then indices (uint16).
    """
    vertices, faces = mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32)
    if len(faces) > triangles:
        vertices, faces = fast_simplification.simplify(vertices, faces, 1 - triangles / len(faces))
    if len(vertices) > 65_535:  # many loose triangles do not decimate
        faces = faces[(faces < 65_535).all(axis=1)]
        vertices = vertices[:65_535]
    if mesh.up == "y":
        vertices = np.column_stack([vertices[:, 0], -vertices[:, 2], vertices[:, 1]])
    places = (np.clip(vertices, -1, 1) * 32767).astype("<i2").tobytes()
    data = base64.b64encode(places + np.asarray(faces).astype("<u2").tobytes()).decode()
    return {"vertices": len(vertices), "faces": len(faces), "data": data}
