"""What a page shows: contact sheets and meshes to turn, truth and reconstructions in one frame; curves."""

import base64
import io
from collections.abc import Callable
from pathlib import Path
from textwrap import shorten
from typing import Any, NamedTuple

import fast_simplification
import matplotlib
import numpy as np
from matplotlib.figure import Figure
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sdfhub.data.sources.mesh_files import read_mesh
from sdfhub.data.store.stored_shape import StoredShape
from sdfhub.errors import SdfhubError
from sdfhub.geometry.render import render
from sdfhub.report.results import ROLES, TABLE_UNIT, Cell, ShapeScore
from sdfhub.report.rows import Group, Row
from sdfhub.shapes import Frame, UpAxis, turned_up

PIXELS, PAPER = 208, 0.955  # side of a picture, and its grey level: a tile on a light page and on a dark one
TRIANGLES = 1500  # of a mesh to turn, some 12 bytes each
FindTruth = Callable[[Cell, str], StoredShape | None]  # a cell's shape by id, where it is on this machine


class ShownMesh(NamedTuple):
    """A mesh to look at, normalised frame: vertices [V, 3] float64, faces [F, 3] int64, its upward axis."""

    vertices: np.ndarray
    faces: np.ndarray
    up: UpAxis


class Tile(NamedTuple):
    """A picture [S, S, 3] uint8, the text below it or in its place, and its `packed` mesh, to be turned."""

    text: str
    image: np.ndarray | None = None
    turning: dict[str, Any] | None = None


class Sheet(NamedTuple):
    """Tiles in rows with labels, under the shapes that they show: role and id."""

    shapes: list[tuple[str, str]]
    rows: list[tuple[str, list[Tile]]]

    @property
    def columns(self) -> list[str]:
        """Captions of the shapes."""
        return [f"{id} ({role.replace('_', ' ')})" for role, id in self.shapes]

    @property
    def turning(self) -> list[dict[str, Any]]:
        """The meshes to turn: a dict a shape with its `name`, its `role` and its meshes, labelled."""
        shapes = []
        for column, (role, id) in enumerate(self.shapes):
            labelled = [(label, tiles[column].turning) for label, tiles in self.rows]
            panels = [{"label": label} | mesh for label, mesh in labelled if mesh]
            shapes += [{"name": id, "role": role.replace("_", " "), "panels": panels}] if panels else []
        return shapes


def contact_sheet_of(group: Group, count: int, find_truth: FindTruth) -> Sheet:
    """Truth, then each row's first finished cell, for `count` shapes: the paper's figures 2 to 6."""
    shapes = chosen(group, count)
    rows = [(row.label, [_shown(row, *shape, find_truth) for shape in shapes]) for row in group.rows]
    truths = [find_truth(group.first, id) for _, id in shapes] if group.first else []
    meshes = [ShownMesh(m.vertices, m.faces, t.up) if t and (m := t.mesh) else None for t in truths]
    if any(meshes):
        rows.insert(0, ("Ground truth", [_tile("", mesh) if mesh else Tile("no truth") for mesh in meshes]))
    return Sheet(shapes, rows)


def _shown(row: Row, role: str, id: str, find_truth: FindTruth) -> Tile:
    """What a row has of a shape."""
    if row.first is None:
        return Tile(row.state)
    score = _scores(row.first, role).get(id)
    if score is None or score.failed:
        return Tile("no surface" if score else "not judged")
    mesh = reconstruction(row.first.folder, role, score, find_truth(row.first, id))
    return _tile(f"CD {score.counted_cd * TABLE_UNIT:.3f}", mesh) if mesh else Tile("no mesh")


def _tile(text: str, mesh: ShownMesh) -> Tile:
    image = render(mesh.vertices, mesh.faces, PIXELS, up=mesh.up, background=PAPER)
    return Tile(text, image, packed(mesh, TRIANGLES))


def reconstruction(cell: Path, role: str, score: ShapeScore, truth: StoredShape | None) -> ShownMesh | None:
    """The reconstruction of a shape in a cell's folder, or None; without truth its extent is its frame."""
    path = cell / "meshes" / role / f"{score.id}.ply"
    if score.failed or not path.resolve().is_relative_to(cell.resolve() / "meshes" / role):
        return None
    try:
        vertices, faces = read_mesh(path)
        frame = truth.frame if truth else Frame.around(vertices)[0]
    except (SdfhubError, OSError, ValueError):  # no such file, a broken one, or a mesh that is a point
        return None
    return ShownMesh(frame.to_normalized(vertices), faces, truth.up if truth else "z")


def packed(mesh: ShownMesh, triangles: int) -> dict[str, Any]:
    """A mesh of at most about `triangles`, +z up; `data`: positions * 32767 (int16), indices (uint16)."""
    vertices, faces = mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32)
    if len(faces) > triangles:
        vertices, faces = fast_simplification.simplify(vertices, faces, 1 - triangles / len(faces))
    faces = faces[(faces < 65_535).all(axis=1)]  # many loose triangles do not decimate
    vertices = turned_up(vertices[:65_535], mesh.up, "z")
    places = (np.clip(vertices, -1, 1) * 32767).astype("<i2").tobytes()
    data = base64.b64encode(places + faces.astype("<u2").tobytes()).decode()
    return {"vertices": len(vertices), "faces": len(faces), "data": data}


def chosen(group: Group, count: int) -> list[tuple[str, str]]:
    """Role and id of the shapes to show: the first training ones, and up to a third held out."""
    train, held_out = (list(_scores(group.first, role)) if group.first else [] for role in ROLES)
    held_out = held_out[: max(count // 3, count - len(train))]
    return [("train", id) for id in train[: count - len(held_out)]] + [("held_out", id) for id in held_out]


def _scores(cell: Cell, role: str) -> dict[str, ShapeScore]:
    """The scores of a role by id; {} where shapes have no surfaces to be judged by."""
    return {s.id: s for s in cell.scores.shapes.get(role, []) if isinstance(s, ShapeScore)}


def picture_uri(image: np.ndarray) -> str:
    """A picture as a WebP data URI."""
    content = io.BytesIO()
    Image.fromarray(image).save(content, "WEBP", quality=82)
    return "data:image/webp;base64," + base64.b64encode(content.getvalue()).decode()


STYLE: dict[Any, Any] = {"svg.fonttype": "none", "svg.hashsalt": "sdfhub", "font.size": 9}
STYLE |= {"axes.grid": True, "grid.color": "#e2e4e8", "axes.spines.top": False, "axes.spines.right": False}


@matplotlib.rc_context(STYLE)
def loss_chart(group: Group) -> str | None:
    """Loss of signed distances by step, a line a seed, as an SVG's data URI; None without any."""
    figure = Figure((7.6, 4.2), layout="constrained")
    axes = figure.subplots()
    for index, row in enumerate(group.rows):
        label = shorten(row.label, 60, placeholder=" …").replace("$", r"\$")  # no formulas
        for curve in filter(None, (loss_curve(cell.folder) for cell in row.done)):
            line = "-" if row.normals == "on" else "--"
            axes.plot(*zip(*curve, strict=True), color=f"C{index % 10}", ls=line, lw=1.3, label=label)
            label = ""
    if not axes.lines:
        return None
    axes.set(xlabel="step", ylabel="clamped L1", yscale="log")
    axes.legend(frameon=False, fontsize=8)
    content = io.BytesIO()
    figure.savefig(content, format="svg", metadata={"Date": None})
    return "data:image/svg+xml;base64," + base64.b64encode(content.getvalue()).decode()


def loss_curve(run: Path, tag: str = "loss/sdf", points: int = 240) -> list[tuple[int, float]]:
    """A logged value by step where above 0, thinned out to so many points; [] where it cannot be read."""
    folder = run / "tensorboard"
    if not folder.resolve().is_relative_to(run.resolve()):
        return []
    try:
        keep = {"scalars": 0, "images": 1, "tensors": 1}  # of each tag; 0 is all
        scalars = EventAccumulator(str(folder), size_guidance=keep).Reload().Scalars(tag)
    except Exception:  # no such folder or tag, or a file that a kill cut off: a picture less, no error
        return []
    curve = sorted({event.step: event.value for event in scalars if 0 < event.value < 1e12}.items())
    return curve[:: max(1, -(-len(curve) // points))]
