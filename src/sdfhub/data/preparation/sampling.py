"""One mesh in, signed samples out."""

from typing import TYPE_CHECKING

import numpy as np

from sdfhub.data.preparation.settings import DEFAULT, Preparation
from sdfhub.data.preparation.signs import SIGN_METHODS, SignMethod, nearest_points, winding_numbers
from sdfhub.data.preparation.visibility import Surface, closed_surface, visible_surface
from sdfhub.errors import RejectedMesh, SdfhubError
from sdfhub.geometry.morton import morton_order
from sdfhub.geometry.surface_sampling import sample_surface
from sdfhub.shapes import Frame, NormalizedMesh, ShapeSamples
from sdfhub.triangles import face_normals, piece_count

if TYPE_CHECKING:
    import trimesh

PROBES = 2000  # samples on which the fast path must agree with the winding number
ZERO_AREA = 1e-15  # of a line, normalised units squared: rounding may leave so much


def prepare_mesh(
    mesh: "trimesh.Trimesh | tuple[np.ndarray, np.ndarray]", preparation: Preparation = DEFAULT, seed: int = 0
) -> ShapeSamples:
    """Signed distances and oriented surface points of one mesh, however broken, in the normalised frame.

    Distances are exact to the faces that can be seen from outside. Rows come in random order, so any slice
    is a fair draw. Two-sided sheets count for `sdf`, which is positive on both their sides, and belong to
    `mesh`; they give no surface points: a field with one sign on both sides has no outward normal there.

    Source: DeepSDF (Park et al. 2019), section 5.

    Args:
        mesh: a mesh, or its vertices [V, 3] and faces [F, 3]; source units.
        preparation: what to sample and what to refuse.
        seed: the same seed gives the same samples.

    Raises:
        RejectedMesh: no trustworthy signs can be had; its `reason` names the rule.
    """
    try:
        vertices, faces = mesh if isinstance(mesh, tuple) else (mesh.vertices, mesh.faces)
    except (AttributeError, ValueError) as error:
        what = "a trimesh.Trimesh, as trimesh.load_mesh(file) gives it, or its vertices and faces"
        raise SdfhubError(f"prepare_mesh takes {what}; got {mesh!r:.60}") from error
    normalized = normalize_mesh(vertices, faces, preparation)
    rng = np.random.default_rng(seed)
    surface = closed_surface(normalized) if preparation.sign == "winding" else None
    signed = _signed_samples(surface, SIGN_METHODS["pseudo_normal"], preparation, rng) if surface else None
    if not surface or not signed or not _winding_agrees(surface, signed[0], signed[1]):
        surface = visible_surface(normalized, preparation, rng)
        method = preparation.sign if callable(preparation.sign) else SIGN_METHODS[preparation.sign]
        signed = _signed_samples(surface, method, preparation, rng)
    points, sdf, statistics = signed
    _refuse_doubtful(statistics["certain"], statistics["inside"], preparation)
    oriented = np.zeros((2, 0, 3))
    if count := preparation.surface_points:
        found = np.stack(sample_surface(surface.vertices, surface.solid(), count, rng))
        oriented = found[:, rng.permutation(count)]
    points, sdf, on_surface, normals = (array.astype(np.float32) for array in (points, sdf, *oriented))
    sampled = NormalizedMesh(surface.vertices, surface.faces, normalized.frame)
    return ShapeSamples(points, sdf, on_surface, normals, normalized.frame, sampled, statistics)


def _refuse_doubtful(certain: float, inside: float, limits: Preparation) -> None:
    if certain < limits.min_certain:
        what = f"{certain:.1%} certain, at least {limits.min_certain:.0%} wanted"
        raise RejectedMesh("ambiguous_signs", what)
    if not limits.min_inside <= inside <= limits.max_inside:
        what = f"{inside:.2%} inside, {limits.min_inside:.1%} to {limits.max_inside:.0%} wanted"
        raise RejectedMesh("inside_fraction", what)


def sample_points(surface: Surface, preparation: Preparation, rng: np.random.Generator) -> np.ndarray:
    """[N, 3] float64 points near the surface and in the cube, in Morton order, exact in float32.

    Some near ones are mirrored in x, y and z in turn.
    """
    near = round(preparation.samples * preparation.near_share)
    points = np.empty((preparation.samples, 3), np.float32)
    deviation = np.sqrt(preparation.variances).astype(np.float32)
    points[:near] = sample_surface(surface.vertices, surface.faces, near, rng)[0]
    jitter = rng.standard_normal((near, 3), np.float32)
    jitter *= deviation[np.arange(near) % len(deviation), None]
    points[:near] += jitter
    decoys = np.arange(round(near * preparation.decoy_share))
    points[decoys, decoys % 3] *= -1
    points[near:] = rng.uniform(-1, 1, (preparation.samples - near, 3))
    return points[morton_order(points)].astype(np.float64)  # the distance is that of the point as stored


def _signed_samples(
    surface: Surface, sign: SignMethod, preparation: Preparation, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, dict[str, float]]:
    """Shuffled points [N, 3], their signed distances [N], and statistics."""
    points = sample_points(surface, preparation, rng)
    nearest = nearest_points(points, surface)
    signs = sign(points, nearest, surface, rng)
    statistics = {"fast_path": 0.0, **surface.statistics, "certain": float(signs.certain.mean())}
    statistics |= {"inside": float(signs.inside.mean()), "faces": float(len(surface.faces))}
    sdf = np.where(signs.inside, -nearest.distance, nearest.distance)
    order = rng.permutation(len(points))
    if preparation.drop_uncertain:
        order = order[signs.certain[order]]
    return points[order], sdf[order], statistics


def _winding_agrees(surface: Surface, points: np.ndarray, sdf: np.ndarray) -> bool:
    """Whether the winding number confirms the pseudo-normal, which self-intersections mislead."""
    probes, sdf = points[:PROBES], sdf[:PROBES]
    return bool(np.mean((winding_numbers(probes, np.abs(sdf), surface) > 0.5) != (sdf < 0)) < 0.002)


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
