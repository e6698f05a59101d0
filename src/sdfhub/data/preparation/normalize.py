"""Raw triangle arrays, validated, moved to the normalised frame and cleaned there."""

import numpy as np

from sdfhub.data.preparation.settings import DEFAULT, Preparation
from sdfhub.errors import RejectedMesh
from sdfhub.shapes import Frame, NormalizedMesh
from sdfhub.triangles import face_normals, piece_count

ZERO_AREA = 1e-15  # of a line, normalised units squared: rounding may leave so much


def normalize_mesh(
    vertices: np.ndarray, faces: np.ndarray, preparation: Preparation = DEFAULT
) -> NormalizedMesh:
    """The mesh in the normalised frame, equal vertices merged, empty and repeated triangles gone.

    Vertices [V, 3] are merged in the normalised frame, where a tolerance means the same for every mesh, be
    its scale 1e20 or 1e-12. Triangles [F, 3] with the same three corners count once, whichever way they turn.
    """
    vertices, faces = _checked_arrays(vertices, faces)
    if len(faces) < preparation.min_faces:
        raise RejectedMesh("too_few_faces", f"{len(faces)} faces, at least {preparation.min_faces} wanted")
    used, faces = np.unique(faces, return_inverse=True)
    vertices = vertices[used]
    half = vertices.max(axis=0) / 2 - vertices.min(axis=0) / 2  # halves first: a sum may overflow
    ratio, wanted = half.min() / max(half.max(), np.finfo(np.float64).tiny), preparation.min_extent_ratio
    if not half.max() > 0 or ratio < wanted:
        raise RejectedMesh("flat", f"smallest over largest extent {ratio:.2g}, at least {wanted} wanted")
    try:
        frame, vertices = Frame.around(vertices)
    except ValueError as error:
        what = f"largest extent {2 * half.max():.2g} cannot be normalised"
        raise RejectedMesh("extent_out_of_range", what) from error
    vertices, faces = _merged(vertices, faces.reshape(-1, 3))
    filled = np.linalg.norm(face_normals(vertices, faces), axis=1) > 2 * ZERO_AREA
    if (empty := 1 - filled.mean()) > preparation.max_zero_area:
        what = f"{empty:.1%} of the faces, at most {preparation.max_zero_area:.0%} wanted"
        raise RejectedMesh("zero_area_faces", what)
    faces = _without_repeats(faces[filled], len(vertices))
    if (count := piece_count(faces, len(vertices))) > preparation.max_components:
        what = f"{count} pieces, at most {preparation.max_components} wanted"
        raise RejectedMesh("too_many_components", what)
    return NormalizedMesh(vertices, faces, frame)


def _checked_arrays(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    try:
        vertices, faces = np.asarray(vertices), np.asarray(faces)
    except ValueError as error:  # rows of different lengths
        raise RejectedMesh("malformed_arrays", str(error)) from error
    if faces.size == 0 or vertices.size == 0:
        raise RejectedMesh("no_faces", f"{len(vertices)} vertices and {len(faces)} faces")
    for name, array, kinds in (("vertices", vertices, "fiu"), ("faces", faces, "iu")):
        if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind not in kinds:
            what = f"{name}: expected [N, 3] numbers, got {list(array.shape)} {array.dtype}"
            raise RejectedMesh("malformed_arrays", what)
    vertices, faces = vertices.astype(np.float64), faces.astype(np.int64)
    if faces.min() < 0 or faces.max() >= len(vertices):
        what = f"{faces.min()} to {faces.max()}, with {len(vertices)} vertices"
        raise RejectedMesh("face_index_out_of_range", what)
    if bad := int((~np.isfinite(vertices)).any(axis=1).sum()):
        raise RejectedMesh("non_finite_vertices", f"{bad} of {len(vertices)} vertices are not finite")
    return vertices, faces


def _merged(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices that share a cell of width 1e-6 become the first of them."""
    cells = np.floor((vertices + 1) * 2**20 + 0.5).astype(np.int64)  # 21 bits an axis: one 63-bit key
    keys = cells[:, 0] << 42 | cells[:, 1] << 21 | cells[:, 2]
    _, first, row = np.unique(keys, return_index=True, return_inverse=True)
    return vertices[first], row[faces]


def _without_repeats(faces: np.ndarray, vertex_count: int) -> np.ndarray:
    """The first of all faces with the same three corners, sorted by their corners."""
    low, middle, high = np.sort(faces, axis=1).T
    pair = np.unique(low * vertex_count + middle, return_inverse=True)[1]  # numbers, faster than rows
    return faces[np.unique(pair * vertex_count + high, return_index=True)[1]]
