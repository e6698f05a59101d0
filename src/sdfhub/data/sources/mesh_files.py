"""Mesh files of the usual formats, read as bare triangles: no materials, no merging, no repair."""

import io
import json
import re
from pathlib import Path
from urllib.parse import unquote

import numpy as np

from sdfhub.data.sources.ac3d import read_ac3d
from sdfhub.errors import RejectedMesh, SdfhubError
from sdfhub.shapes import Mesh

FORMATS = (".obj", ".ply", ".stl", ".off", ".glb", ".gltf", ".ac")
MAX_BYTES = 1 << 30  # of a file: text formats take some ten times their size in memory
MAX_VERTICES = 50_000_000  # of a glTF's scene: a small file may draw one mesh many times

_OFF_COUNTS = re.compile(rb"(?:\s|#[^\n]*\n)*OFF(?:\s|#[^\n]*\n)+(\d+)\s+(\d+)(?:[ \t]+\d+)?")
_BAD_NUMBER = re.compile(rb"^[ \t]*v[ \t][^\n#]*\b(nan|inf)", re.IGNORECASE | re.MULTILINE)


def read_mesh(path: str | Path) -> Mesh:
    """The mesh in a file, in the file's frame and units: parts of a scene in place, polygons as triangles.

    Raises SdfhubError for a file that is missing, too large or of no known format, and RejectedMesh
    (empty_file, corrupt_file, no_faces, non_finite_vertices, ...) with the file's name.
    """
    path = Path(path)
    if path.suffix.lower() not in FORMATS:
        raise SdfhubError(f"{path}: not a mesh format known here ({' '.join(FORMATS)})")
    if not path.is_file():
        raise SdfhubError(f"{path}: no such file")
    if path.stat().st_size > MAX_BYTES:
        raise SdfhubError(f"{path}: larger than {MAX_BYTES >> 20} MiB; decimate the mesh first")
    return triangles_of(path.read_bytes(), path.suffix.lower(), str(path), path.parent)


def triangles_of(content: bytes, suffix: str, name: str, folder: Path | None = None) -> Mesh:
    """The triangles of a mesh file's content; a .gltf finds its buffers in `folder` (None: nowhere)."""
    if not content.strip():
        raise RejectedMesh("empty_file", f"{name} holds nothing")
    if suffix == ".obj" and (bad := _BAD_NUMBER.search(content)):
        line = bad[0].strip().decode(errors="replace")
        raise RejectedMesh("non_finite_vertices", f"{name} has the line {line!r}")
    try:
        check_length(content, suffix)
        buffers = _gltf_buffers(content, suffix, folder) if suffix in (".glb", ".gltf") else {}
        mesh = read_ac3d(content) if suffix == ".ac" else _by_trimesh(content, suffix, buffers)
    except RejectedMesh as rejection:
        raise RejectedMesh(rejection.reason, f"{name}: {rejection.detail}") from rejection
    except MemoryError:  # no fault of the file
        raise
    except Exception as error:  # trimesh raises whatever the broken bytes lead to
        is_foreign = isinstance(error, ImportError)  # it would guess the encoding of binary content
        why = "not of this format" if is_foreign else f"{type(error).__name__}: {error}"
        raise RejectedMesh("corrupt_file", f"{name} cannot be read as {suffix[1:]} ({why})") from error
    vertices, faces = mesh
    if not faces.size:
        raise RejectedMesh("no_faces", f"{name} holds no faces: a point cloud, not a mesh")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise RejectedMesh("corrupt_file", f"{name} has a face with a vertex that is not there")
    if bad_rows := int((~np.isfinite(vertices)).any(axis=1).sum()):
        raise RejectedMesh("non_finite_vertices", f"{name} has {bad_rows} vertices that are not finite")
    return mesh


def check_length(content: bytes, suffix: str) -> None:
    """Refuses files that end before all that their header promises; trimesh takes what there is."""
    promised, held = 0, len(content)
    if suffix == ".glb":
        promised = int.from_bytes(content[8:12], "little")
    elif suffix == ".stl" and not content.lstrip().startswith(b"solid"):
        promised = 84 + 50 * int.from_bytes(content[80:84], "little")
    elif suffix == ".ply" and b"\nformat ascii" in content[:1000]:
        head, _, body = content.partition(b"end_header")
        rows = re.findall(rb"^element\s+\w+\s+(\d+)", head, re.MULTILINE)
        promised, held = sum(map(int, rows)), _lines(body)
    elif suffix == ".off" and (counts := _OFF_COUNTS.match(content)):
        promised, held = sum(map(int, counts.groups())), _lines(content[counts.end() :])
    if promised > held:
        raise RejectedMesh("corrupt_file", f"ends too early: its header promises {promised}, it holds {held}")


def _lines(body: bytes) -> int:
    """Number of lines that are not blank."""
    return sum(1 for line in body.splitlines() if line.strip())


def _gltf_buffers(content: bytes, suffix: str, folder: Path | None) -> dict[str, bytes]:
    """The files that a glTF names; refuses vertices that trimesh would take for zeros, or too many."""
    if suffix == ".glb":
        content, folder = content[20 : 20 + int.from_bytes(content[12:16], "little")], None
    scene = json.loads(content)
    meshes, accessors = scene.get("meshes", []), scene.get("accessors", [])
    parts = [part for mesh in meshes for part in mesh["primitives"]]
    names = {*scene.get("extensionsRequired", []), *scene.get("extensions", {})}
    names = names.union(*(part.get("extensions", {}) for part in parts))
    if packed := sorted(name for name in names if "compression" in name):
        raise RejectedMesh("compressed", f"needs {', '.join(packed)}; export it without compression")
    if any("bufferView" not in accessor and "sparse" not in accessor for accessor in accessors):
        raise RejectedMesh("corrupt_file", "claims numbers that it does not hold")
    counts = [sum(accessors[p["attributes"]["POSITION"]]["count"] for p in m["primitives"]) for m in meshes]
    drawn = sum(counts[node["mesh"]] for node in scene.get("nodes", []) if "mesh" in node)
    if drawn > MAX_VERTICES:
        raise RejectedMesh("too_large", f"draws {drawn:,} vertices, at most {MAX_VERTICES:,} are read")
    paths = {name: buffer_path(folder, name) for name in buffer_names(scene)}
    if missing := [name for name, path in paths.items() if not path]:
        raise RejectedMesh("corrupt_file", f"its buffer {missing[0]!r} does not lie beside it")
    return {name: path.read_bytes() for name, path in paths.items() if path}


def buffer_names(scene: dict) -> list[str]:
    """The files that a glTF's JSON names."""
    names = [buffer.get("uri", "data:") for buffer in scene.get("buffers", [])]
    return [name for name in names if not name.startswith("data:")]


def buffer_path(folder: Path | None, name: str) -> Path | None:
    """Where a file that a .gltf in `folder` names lies, or None where that is not below it, or too large."""
    if not folder:
        return None
    # names are percent-encoded, but some exporters write them as they are
    paths = [(folder / spelling).resolve() for spelling in (name, unquote(name))]
    paths = [path for path in paths if path.is_relative_to(folder.resolve()) and path.is_file()]
    return paths[0] if paths and paths[0].stat().st_size <= MAX_BYTES else None


def _by_trimesh(content: bytes, suffix: str, buffers: dict[str, bytes]) -> Mesh:
    import trimesh  # here: slow to import, and a training on a filled store reads no mesh file

    if suffix in (".obj", ".off"):  # names and comments may be in any encoding, numbers are the same in all
        content = content.decode(errors="replace").encode()
    file, kind = io.BytesIO(content), suffix[1:]
    with np.errstate(all="ignore"):  # it computes with infinite vertices, which are refused later
        mesh = trimesh.load_mesh(file, kind, process=False, resolver=buffers, skip_materials=True)
    return Mesh(np.array(mesh.vertices, dtype=np.float64), np.array(mesh.faces, dtype=np.int64))
