"""Meshes as files: one, or several in a row."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sdfhub.shapes import Mesh, UpAxis, turned_up
from sdfhub.whole_file import write_whole

FORMATS = ("ply", "obj", "glb")  # formats of written meshes
FAR = 16  # sizes of a mesh from the origin, from where 32 bits lose a millionth of it: geographic coordinates


def write_mesh(vertices: np.ndarray, faces: np.ndarray, path: Path) -> None:
    """Writes a mesh as its path's suffix says, whole or not at all; without faces removes an earlier one."""
    if not len(faces):
        path.unlink(missing_ok=True)
    elif path.suffix == ".ply":
        write_whole(path, _ply(vertices, faces))
    else:
        import trimesh  # here: slow to import, and every training would wait for it before its first step

        mesh: Any = trimesh.Trimesh(vertices, faces, process=False)
        write_whole(path, mesh.export(file_type=path.suffix[1:]))


def _ply(vertices: np.ndarray, faces: np.ndarray) -> bytes:
    """A binary PLY, with 64-bit coordinates where 32 are too few: trimesh writes no others."""
    is_far = np.abs(vertices).max() > FAR * np.ptp(vertices, axis=0).max()
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    head += [f"property {'double' if is_far else 'float'} {axis}" for axis in "xyz"]
    head += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    rows = np.empty(len(faces), [("count", "u1"), ("corners", "<i4", 3)])
    rows["count"], rows["corners"] = 3, faces
    coordinates = np.asarray(vertices, "<f8" if is_far else "<f4")
    return "\n".join(head).encode() + coordinates.tobytes() + rows.tobytes()


def write_row(meshes: Sequence[Mesh], up: UpAxis, path: Path) -> None:
    """Writes meshes, normalised frame, side by side as a .glb, upright for viewers; leaves out empty ones."""
    import trimesh

    scene = trimesh.Scene()
    for index, (vertices, faces) in enumerate(meshes):
        if len(faces):
            moved = trimesh.Trimesh(turned_up(vertices, up, "y") + [2.1 * index, 0, 0], faces, process=False)
            scene.add_geometry(moved, node_name=f"{index}")
    if scene.geometry:
        write_whole(path, scene.export(file_type=path.suffix[1:]))
