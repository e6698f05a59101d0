"""What a page shows of shapes: contact sheets, and meshes to turn; truth and reconstructions in one frame."""

import base64
import io
import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import fast_simplification
import numpy as np
import trimesh
from PIL import Image

from sdfhub.data.store.stored_shape import StoredShape
from sdfhub.data.workers import stream_in_processes
from sdfhub.geometry.render import render
from sdfhub.geometry.up_axis import UpAxis, turned_up
from sdfhub.report.results import ROLES, TABLE_UNIT, Cell, ShapeScore
from sdfhub.report.rows import Group
from sdfhub.shapes import Frame

PIXELS, PAPER = 208, 0.955
"""Side of a picture, and the grey level behind the shape: a tile on a light page and on a dark one."""

FEWEST, MOST = 400, 4000  # triangles of a mesh to turn
TO_TURN = 4  # shapes to turn for each group, at most
A_WORKERS_WORTH = 32  # meshes for which it pays to start a process that draws them
FindTruth = Callable[[Cell, str], StoredShape | None]
"""The prepared shape of an id that a cell was trained or judged on; None where it is not on this machine."""


class ShownMesh(NamedTuple):
    """A mesh to look at, normalised frame: vertices [V, 3] float64, faces [F, 3] int64, its upward axis."""

    vertices: np.ndarray
    faces: np.ndarray
    up: UpAxis


def true_mesh(truth: StoredShape | None) -> ShownMesh | None:
    """The true mesh; None where it cannot be had."""
    mesh = truth.mesh if truth else None
    return ShownMesh(mesh.vertices, mesh.faces, truth.up) if truth and mesh else None


def reconstruction(cell: Path, role: str, score: ShapeScore, truth: StoredShape | None) -> ShownMesh | None:
    """The reconstruction of a shape in a cell's folder; None where there is no surface.

    Where the truth is not there to say what the normalised frame was, the mesh's own extent does.
    """
    path = cell / "meshes" / role / f"{score.id}.ply"
    if score.failed or not path.resolve().is_relative_to(cell.resolve() / "meshes" / role):
        return None
    try:
        with path.open("rb") as file:
            mesh = trimesh.load_mesh(file, file_type="ply", process=False)
        vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
        if not (np.isfinite(vertices).all() and 0 <= faces.min() <= faces.max() < len(vertices)):
            return None
        frame = truth.frame if truth else Frame.around(vertices)[0]
    except Exception:  # no such file, no face, or one of the ways in which trimesh meets a broken file
        return None
    return ShownMesh(frame.to_normalized(vertices), faces, truth.up if truth else "z")


def packed(mesh: ShownMesh, triangles: int) -> dict[str, Any]:
    """A mesh of at most about `triangles`, +z up, as little-endian 16-bit integers in base64.

    Returns:
        `vertices` and `faces`: counts; `data`: positions times 32767 (int16), then indices (uint16).
    """
    vertices, faces = mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32)
    if len(faces) > triangles:
        vertices, faces = fast_simplification.simplify(vertices, faces, 1 - triangles / len(faces))
    faces = faces[(faces < 65_535).all(axis=1)]  # many loose triangles do not decimate
    vertices = turned_up(vertices[:65_535], mesh.up, "z")
    places = (np.clip(vertices, -1, 1) * 32767).astype("<i2").tobytes()
    data = base64.b64encode(places + faces.astype("<u2").tobytes()).decode()
    return {"vertices": len(vertices), "faces": len(faces), "data": data}


@dataclass
class Tile:
    """A picture [S, S, 3] uint8 of what `read` reads, and the text below it or in its place."""

    text: str
    read: Callable[[], ShownMesh | None] | None = None
    image: np.ndarray | None = None


@dataclass(frozen=True)
class Sheet:
    """Pictures in rows with labels, under columns with captions."""

    columns: list[str]
    rows: list[tuple[str, list[Tile]]]


def contact_sheets(groups: list[Group], count: int, find_truth: FindTruth) -> list[Sheet]:
    """Truth, then each row of a group, for some shapes, a sheet a group: the paper's figures 2 to 6."""
    sheets = [_sheet(group, count, find_truth) for group in groups]
    tiles = [tile for sheet in sheets for _, row in sheet.rows for tile in row if tile.read]
    readers = [tile.read for tile in tiles]
    workers = min(os.cpu_count() or 1, len(readers) // A_WORKERS_WORTH)
    images: Any = stream_in_processes(picture, readers, workers)
    for tile, image in zip(tiles, images, strict=True):
        tile.image, tile.text = image, "no mesh" if image is None else tile.text
    return sheets


def _sheet(group: Group, count: int, find_truth: FindTruth) -> Sheet:
    shown, first = chosen(group, count), group.first
    truths = [_truth_tile(find_truth(first, id)) for _, id in shown] if first else []
    rows = [("Ground truth", truths)] if any(tile.read for tile in truths) else []
    for row in group.rows:
        absent = "failed" if any(cell.state == "failed" for cell in row.cells) else "missing"
        cell = row.first
        rows.append((row.label, [_tile(cell, *s, find_truth) if cell else Tile(absent) for s in shown]))
    return Sheet([f"{id} ({role.replace('_', ' ')})" for role, id in shown], rows)


def _truth_tile(truth: StoredShape | None) -> Tile:
    return Tile("", partial(true_mesh, truth)) if truth and truth.rows("faces") else Tile("no truth")


def _tile(cell: Cell, role: str, id: str, find_truth: FindTruth) -> Tile:
    score = _scores(cell, role).get(id)
    if score is None or score.failed:
        return Tile("no surface" if score else "not judged")
    read = partial(reconstruction, cell.folder, role, score, find_truth(cell, id))
    return Tile(f"CD {score.counted_cd * TABLE_UNIT:.3f}", read)


def picture(read_mesh: Callable[[], ShownMesh | None]) -> np.ndarray | None:
    """[S, S, 3] uint8 of a mesh from the usual side; None without one."""
    mesh = read_mesh()
    return render(mesh.vertices, mesh.faces, PIXELS, up=mesh.up, background=PAPER) if mesh else None


def turning_meshes(group: Group, count: int, room: int, find_truth: FindTruth) -> list[dict]:
    """Some shapes of a group, truth and rows, decimated to some `room` bytes for the viewer of the page.

    Returns:
        A dict a shape: `name`, `role` and `panels`, its meshes as `packed` with a `label` each.
    """
    shown, cells = (
        chosen(group, min(count, TO_TURN)),
        {row.label: row.first for row in group.rows if row.first},
    )
    triangles = room // max(1, len(shown) * (len(cells) + 1) * 12)  # some 12 bytes each, as base64
    triangles = min(MOST, max(FEWEST, triangles))
    shapes = []
    for role, id in shown:
        readers = {label: _tile(cell, role, id, find_truth).read for label, cell in cells.items()}
        readers = {"Ground truth": _truth_tile(find_truth(next(iter(cells.values())), id)).read} | readers
        meshes = {label: read() for label, read in readers.items() if read}
        panels = [{"label": label} | packed(mesh, triangles) for label, mesh in meshes.items() if mesh]
        shapes += [{"name": id, "role": role.replace("_", " "), "panels": panels}] if panels else []
    return shapes


def chosen(group: Group, count: int) -> list[tuple[str, str]]:
    """Role and id of the shapes to show: the first training ones, and up to a third held out."""
    train, held_out = (list(_scores(group.first, role)) if group.first else [] for role in ROLES)
    held_out = held_out[: max(count // 3, count - len(train))]
    train = train[: count - len(held_out)]
    return [("train", id) for id in train] + [("held_out", id) for id in held_out]


def _scores(cell: Cell, role: str) -> dict[str, ShapeScore]:
    """The scores of a role by id; {} where shapes have no surfaces to be judged by."""
    return {s.id: s for s in cell.result.shapes.get(role, []) if isinstance(s, ShapeScore)}


def picture_uri(image: np.ndarray) -> str:
    """A picture as a WebP data URI."""
    content = io.BytesIO()
    Image.fromarray(image).save(content, "WEBP", quality=82)
    return "data:image/webp;base64," + base64.b64encode(content.getvalue()).decode()
