"""Meshes as files: one, or several in a row."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sdfhub.geometry.mesher import Mesh
from sdfhub.whole_file import write_whole

FORMATS = ("ply", "obj", "glb")
"""What meshes can be written as."""


def write_mesh(vertices: np.ndarray, faces: np.ndarray, path: Path) -> None:
    """Writes a mesh in the format of the path's suffix, whole or not at all; nothing where it has no faces.

    Args:
        vertices: [V, 3], in any frame.
        faces: [F, 3].
        path: ends in one of FORMATS.
    """
    if len(faces):
        import trimesh  # here: slow to import, and every training would wait for it before its first step

        _write(trimesh.Trimesh(vertices, faces, process=False), path)


def write_row(meshes: Sequence[Mesh], up: str, path: Path) -> None:
    """Writes meshes side by side as one scene, upright for viewers (+y up); empty ones are left out.

    Args:
        meshes: in the normalised frame.
        up: their axis that points up.
        path: of a .glb file.
    """
    import trimesh

    scene = trimesh.Scene()
    for index, (vertices, faces) in enumerate(meshes):
        if len(faces):
            x, y, z = vertices.T
            upright = vertices if up == "y" else np.column_stack([x, z, -y])
            moved = trimesh.Trimesh(upright + [2.1 * index, 0, 0], faces, process=False)
            scene.add_geometry(moved, node_name=f"{index}")
    if scene.geometry:
        _write(scene, path)


def _write(content, path: Path) -> None:
    exported = content.export(file_type=path.suffix[1:])
    write_whole(path, exported.encode() if isinstance(exported, str) else exported)
