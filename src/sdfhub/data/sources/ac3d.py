"""AC3D, the text format of FlightGear's aircraft: a tree of polygon objects.

Source: AC3D file format specification (inivis).
"""

import io
from itertools import pairwise

import numpy as np

from sdfhub.errors import RejectedMesh
from sdfhub.shapes import Mesh

MAX_DEPTH = 100
POLYGON, STRIP = 0, 4  # surfaces with an area (low four bits of `SURF`); 1 and 2: closed and open lines


def read_ac3d(content: bytes) -> Mesh:
    """The mesh of an AC3D file, all objects in the world's frame.

    Polygons become fans, lines are skipped.

    Raises:
        RejectedMesh: corrupt_file; no AC3D file, or one that ends too early.
    """
    if not content.startswith(b"AC3D"):
        raise RejectedMesh("corrupt_file", "does not start with AC3D")
    reader, parts = _Lines(content), [Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64))]
    try:
        while (line := reader.next_line()) is not None:
            if line[:1] == ["OBJECT"]:
                _read_object(reader, parts, np.eye(3), np.zeros(3), 0)
    except (ValueError, IndexError, OverflowError) as error:
        raise RejectedMesh("corrupt_file", f"byte {reader.tell()}: {error}") from error
    first = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = [part.faces + offset for part, offset in zip(parts, first, strict=False)]
    return Mesh(np.concatenate([part.vertices for part in parts]), np.concatenate(faces))


class _Lines(io.BytesIO):
    """Lines of the file as lists of words."""

    def next_line(self) -> list[str] | None:
        """The words of the next line that is not blank, or None at the end."""
        return next((words for line in self if (words := line.decode("latin-1").split())), None)

    def line(self) -> list[str]:
        """The words of a line that must be there."""
        if (words := self.next_line()) is None:
            raise ValueError("the file ends in the middle of an object")
        return words


def _read_object(
    reader: _Lines, parts: list[Mesh], rotation: np.ndarray, origin: np.ndarray, depth: int
) -> None:
    """Reads one object and its kids, given the parent's rotation [3, 3], from the left, and origin [3]."""
    if depth > MAX_DEPTH:
        raise ValueError(f"objects are nested more than {MAX_DEPTH} deep")
    own_rotation, location, vertices = np.eye(3), np.zeros(3), np.zeros((0, 3))
    surfaces: list[tuple[int, int, int]] = []
    kids = None
    while kids is None:
        words = reader.line()
        match words[0]:
            case "rot":
                own_rotation = np.array(words[1:10], dtype=np.float64).reshape(3, 3)
            case "loc":
                location = np.array(words[1:4], dtype=np.float64).reshape(3)
            case "data":
                reader.read(int(words[1]) + 1)  # and the end of its line
            case "numvert":
                rows = [reader.line()[:3] for _ in range(int(words[1]))]
                vertices = np.array(rows, dtype=np.float64).reshape(len(rows), 3)
            case "numsurf":
                surfaces = [face for _ in range(int(words[1])) for face in _read_surface(reader)]
            case "kids":
                kids = int(words[1])
    origin = location @ rotation + origin
    rotation = own_rotation @ rotation
    faces = np.array(surfaces, dtype=np.int64).reshape(-1, 3)
    if faces.size and not 0 <= faces.min() <= faces.max() < len(vertices):
        raise ValueError("a surface has a vertex that is not there")
    parts.append(Mesh(vertices @ rotation + origin, faces))
    for _ in range(kids):
        line = reader.next_line()
        while line and line[0] != "OBJECT":
            line = reader.next_line()
        if not line:
            return  # many files announce more kids than they hold
        _read_object(reader, parts, rotation, origin, depth + 1)


def _read_surface(reader: _Lines) -> list[tuple[int, int, int]]:
    """The triangles of one surface; none for a line."""
    kind, words = POLYGON, reader.line()
    while words[:1] != ["refs"]:
        if words[:1] == ["SURF"]:
            kind = int(words[1], 16) & 15
        elif words[:1] != ["mat"]:
            raise ValueError(f"{words[0]!r} instead of a surface's refs")
        words = reader.line()
    corners = [int(reader.line()[0]) for _ in range(int(words[1]))]
    if kind == POLYGON:
        return [(corners[0], b, c) for b, c in pairwise(corners[1:])]
    if kind == STRIP:
        triples = zip(corners, corners[1:], corners[2:], strict=False)
        return [(a, b, c) if i % 2 == 0 else (b, a, c) for i, (a, b, c) in enumerate(triples)]
    return []
