"""AC3D, the text format of FlightGear's aircraft: a tree of polygon objects.

Source: AC3D file format specification (inivis).
"""

import io
from itertools import pairwise

import numpy as np

from sdfhub.errors import RejectedMesh
from sdfhub.shapes import Mesh

POLYGON, STRIP = 0, 4  # surfaces with an area (low four bits of `SURF`); 1 and 2: closed and open lines


def read_ac3d(content: bytes) -> Mesh:
    """The mesh of an AC3D file, all objects in the world's frame; polygons become fans, lines are skipped."""
    if not content.startswith(b"AC3D"):
        raise RejectedMesh("corrupt_file", "does not start with AC3D")
    reader, count = _Lines(content), 0
    vertices, faces = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)]
    above: list[tuple[int, np.ndarray, np.ndarray]] = []  # kids that are to come, rotation, origin
    try:
        for line in reader:  # many files announce more kids than they hold
            if line.split()[:1] == [b"OBJECT"]:
                while above and above[-1][0] <= 0:
                    above.pop()
                left, outer, place = above.pop() if above else (0, np.eye(3), np.zeros(3))
                above.append((left - 1, outer, place))
                points, triangles, rotation, location, kids = _object(reader)
                rotation, origin = rotation @ outer, location @ outer + place
                vertices.append(points @ rotation + origin)
                faces.append(triangles + count)
                count += len(points)
                above.append((kids, rotation, origin))
    except (ValueError, IndexError, OverflowError) as error:
        raise RejectedMesh("corrupt_file", f"byte {reader.tell()}: {error}") from error
    return Mesh(np.concatenate(vertices), np.concatenate(faces))


class _Lines(io.BytesIO):
    def words(self) -> list[str]:
        """Those of the next line that is not blank."""
        for line in self:
            if words := line.decode("latin-1").split():
                return words
        raise ValueError("the file ends in the middle of an object")


def _object(reader: _Lines) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, int]:
    """Vertices [V, 3] and faces [F, 3] of an object, its rotation from the left, its place, and its kids."""
    rotation, location, vertices = np.eye(3), np.zeros(3), np.zeros((0, 3))
    triangles: list[tuple[int, int, int]] = []
    while (words := reader.words())[0] != "kids":
        match words[0]:
            case "rot":
                rotation = np.array(words[1:10], dtype=np.float64).reshape(3, 3)
            case "loc":
                location = np.array(words[1:4], dtype=np.float64).reshape(3)
            case "data":
                reader.read(int(words[1]) + 1)  # and the end of its line
            case "numvert":
                rows = [reader.words()[:3] for _ in range(int(words[1]))]
                vertices = np.array(rows, dtype=np.float64).reshape(len(rows), 3)
            case "numsurf":
                triangles = [triangle for _ in range(int(words[1])) for triangle in _surface(reader)]
    faces = np.array(triangles, dtype=np.int64).reshape(-1, 3)
    if faces.size and not 0 <= faces.min() <= faces.max() < len(vertices):
        raise ValueError("a surface has a vertex that is not there")
    return vertices, faces, rotation, location, int(words[1])


def _surface(reader: _Lines) -> list[tuple[int, int, int]]:
    """The triangles of one surface; none for a line."""
    kind, words = POLYGON, reader.words()
    while words[0] != "refs":
        if words[0] == "SURF":
            kind = int(words[1], 16) & 15
        elif words[0] != "mat":
            raise ValueError(f"{words[0]!r} instead of a surface's refs")
        words = reader.words()
    corners = [int(reader.words()[0]) for _ in range(int(words[1]))]
    if kind == POLYGON:
        return [(corners[0], b, c) for b, c in pairwise(corners[1:])]
    if kind == STRIP:
        triples = zip(corners, corners[1:], corners[2:], strict=False)
        return [(a, b, c) if i % 2 == 0 else (b, a, c) for i, (a, b, c) in enumerate(triples)]
    return []
