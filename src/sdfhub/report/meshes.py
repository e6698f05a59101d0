"""The meshes of a report in one frame: reconstructions of the cells and the truth behind them."""

import base64
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import fast_simplification
import numpy as np
import trimesh

from sdfhub.data.store.stored_shape import StoredShape
from sdfhub.geometry.up_axis import UpAxis, turned_up
from sdfhub.report.results import Cell, ShapeScore
from sdfhub.shapes import Frame

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
        frame = Frame(truth.center, truth.scale) if truth else Frame.around(vertices)[0]
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
