"""Meshes as files: one, or several in a row."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sdfhub.geometry.mesher import Mesh
from sdfhub.whole_file import write_whole

FORMATS = ("ply", "obj", "glb")
"""What meshes can be written as."""

FAR = 16
"""Distance from the origin, in sizes of a mesh, beyond which 32-bit coordinates lose a millionth of it: scans
in geographic coordinates lie far beyond. GLB knows no others; OBJ is text."""


def write_mesh(vertices: np.ndarray, faces: np.ndarray, path: Path) -> None:
    """Writes a mesh in the format of the path's suffix, whole or not at all.

    Where it has no faces nothing is written, and what an earlier mesh left there goes.

    Args:
        vertices: [V, 3], in any frame.
        faces: [F, 3].
        path: ends in one of FORMATS.
    """
    size = np.ptp(vertices, axis=0).max() if len(faces) else 0
    if len(faces) and path.suffix == ".ply" and np.abs(vertices).max() > FAR * size:
        write_whole(path, _ply_of_doubles(vertices, faces))
    elif len(faces):
        import trimesh  # here: slow to import, and every training would wait for it before its first step

        _write(trimesh.Trimesh(vertices, faces, process=False), path)
    else:
        path.unlink(missing_ok=True)


def _ply_of_doubles(vertices: np.ndarray, faces: np.ndarray) -> bytes:
    """A binary PLY with 64-bit coordinates, which trimesh does not write."""
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    head += [f"property double {axis}" for axis in "xyz"]
    head += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    rows = np.empty(len(faces), [("count", "u1"), ("corners", "<i4", 3)])
    rows["count"], rows["corners"] = 3, faces
    return "\n".join(head).encode() + np.asarray(vertices, "<f8").tobytes() + rows.tobytes()


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
