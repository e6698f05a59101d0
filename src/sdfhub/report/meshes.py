"""The meshes of a report in one frame: reconstructions of the cells and the truth behind them."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import trimesh

from sdfhub.data.store.stored_shape import StoredShape
from sdfhub.report.results import Cell, ShapeScore
from sdfhub.shapes import RADIUS

FindTruth = Callable[[Cell, str], StoredShape | None]
"""The prepared shape of an id that a cell was trained or judged on; None where it is not on this machine."""


@dataclass(frozen=True)
class Mesh:
    """A mesh to be looked at.

    Args:
        vertices: [V, 3] float64, normalised frame, within the unit ball or nearly.
        faces: [F, 3] int64.
        up: the axis that points up.
    """

    vertices: np.ndarray
    faces: np.ndarray
    up: Literal["y", "z"]


def true_mesh(truth: StoredShape | None) -> Mesh | None:
    """The true mesh; None where it cannot be had."""
    mesh = truth.mesh if truth else None
    return Mesh(mesh.vertices, mesh.faces, truth.up) if mesh else None


def reconstruction(cell: Path, role: str, score: ShapeScore, truth: StoredShape | None) -> Mesh | None:
    """The reconstruction of a shape in a cell's folder, normalised frame; None where there is no surface.

    Where the truth is not there to say what the frame was, the mesh's own extent does.
    """
    folder = cell / "meshes" / role
    path = folder / f"{score.id}.ply"
    if score.failed or not path.resolve().is_relative_to(folder.resolve()) or not path.is_file():
        return None
    read = _read_ply(path)
    if read is None:
        return None
    vertices, faces = read
    if truth is None:
        center = (vertices.min(0) + vertices.max(0)) / 2
        scale = RADIUS / max(np.linalg.norm(vertices - center, axis=1).max(), 1e-12)
    else:
        center, scale = truth.center, truth.scale
    return Mesh((vertices - center) * scale, faces, truth.up if truth else "z")


def _read_ply(path: Path) -> tuple[np.ndarray, np.ndarray] | None:
    try:
        with path.open("rb") as file:
            mesh = trimesh.load_mesh(file, file_type="ply", process=False)
        vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    except Exception:  # trimesh meets a broken file in many ways
        return None
    whole = len(faces) and np.isfinite(vertices).all() and 0 <= faces.min() <= faces.max() < len(vertices)
    return (vertices, faces) if whole else None
