"""One mesh in, signed samples out."""

from typing import TYPE_CHECKING

import numpy as np

from sdfhub.data.preparation.normalize import normalize_mesh
from sdfhub.data.preparation.settings import DEFAULT, Preparation
from sdfhub.data.preparation.signs import SIGN_METHODS, SignMethod, nearest_points
from sdfhub.data.preparation.visibility import Surface, closed_surface, visible_surface
from sdfhub.errors import RejectedMesh, SdfhubError
from sdfhub.geometry.morton import morton_order
from sdfhub.geometry.surface_sampling import sample_surface
from sdfhub.shapes import NormalizedMesh, ShapeSamples

if TYPE_CHECKING:
    import trimesh

PROBES = 2000  # samples on which the fast path must agree with the winding number


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
    if not surface or not signed or not _winding_agrees(surface, signed[0], signed[1], rng):
        surface = visible_surface(normalized, preparation, rng)
        method = preparation.sign if callable(preparation.sign) else SIGN_METHODS[preparation.sign]
        signed = _signed_samples(surface, method, preparation, rng)
    points, sdf, statistics = signed
    _refuse_doubtful(statistics["certain"], statistics["inside"], preparation)
    oriented = np.zeros((2, 0, 3))
    if count := preparation.surface_points:
        found = np.stack(sample_surface(surface.vertices, surface.solid(), count, rng))
        oriented = found[:, rng.permutation(count)]
    arrays = (array.astype(np.float32) for array in (points, sdf, *oriented))
    sampled = NormalizedMesh(surface.vertices, surface.faces, normalized.frame)
    return ShapeSamples(*arrays, normalized.frame, sampled, statistics)


def _refuse_doubtful(certain: float, inside: float, limits: Preparation) -> None:
    if certain < limits.min_certain:
        what = f"{certain:.1%} certain, at least {limits.min_certain:.0%} wanted"
        raise RejectedMesh("ambiguous_signs", what)
    if not limits.min_inside <= inside <= limits.max_inside:
        what = f"{inside:.2%} inside, {limits.min_inside:.1%} to {limits.max_inside:.0%} wanted"
        raise RejectedMesh("inside_fraction", what)


def sample_points(surface: Surface, preparation: Preparation, rng: np.random.Generator) -> np.ndarray:
    """[N, 3] float64 points near the surface and in the cube, in Morton order, exact in float32."""
    near = round(preparation.samples * preparation.near_share)
    points = np.empty((preparation.samples, 3), np.float32)
    deviation = np.sqrt(preparation.variances).astype(np.float32)
    points[:near] = sample_surface(surface.vertices, surface.faces, near, rng)[0]
    jitter = rng.standard_normal((near, 3), np.float32)
    jitter *= deviation[np.arange(near) % len(deviation), None]
    points[:near] += jitter
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


def _winding_agrees(surface: Surface, points: np.ndarray, sdf: np.ndarray, rng: np.random.Generator) -> bool:
    """Whether the winding number confirms the pseudo-normal, which self-intersections mislead."""
    order = morton_order(points[:PROBES])
    probes, sdf = points[order], sdf[order]
    inside = SIGN_METHODS["winding"](probes, nearest_points(probes, surface), surface, rng).inside
    return bool(np.mean(inside != (sdf < 0)) < 0.002)
