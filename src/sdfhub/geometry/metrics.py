"""How good a reconstructed mesh is: Chamfer distance, its noise floor, and what Chamfer does not see.

All meshes are (vertices [V, 3], faces [F, 3]) in one frame, the normalised one unless a name says `source`.
Lengths are in that frame's units, Chamfer distances in their squares; nothing is multiplied by 10^3 here.

A Chamfer distance between finite samples is never zero: two samplings of one surface differ by the *noise
floor*, which grows with area and falls with the number of points. `excess` is what lies above it.
"""

from dataclasses import dataclass, fields

import igl
import numpy as np
from scipy.spatial import cKDTree

from sdfhub.geometry.winding import closed_winding_numbers
from sdfhub.shapes import NormalizedMesh
from sdfhub.triangles import face_normals, piece_count

Mesh = tuple[np.ndarray, np.ndarray]

IOU_POINTS = 20_000
"""Uniform points for the volumetric IoU."""

FAILURES = (
    "failed: shapes without a reconstructed surface. They enter no statistic but cd_mean_with_failures and "
    "cd_median_with_failures, where each counts as if its reconstruction were one point at the origin."
)
"""How `summarize` treats failures, in words for a report."""


@dataclass(frozen=True)
class ShapeMetrics:
    """The judgement of one reconstruction; None where a value does not exist.

    Args:
        cd: mean squared nearest distance between samples, both directions added.
        floor: `cd` of two independent samplings of the ground truth.
        excess: cd - floor; below 0 by chance where a reconstruction is as good as the truth.
        cd_source: `cd` in squared units of the source's own frame.
        point_to_surface: mean of `accuracy` and `completeness`.
        accuracy: mean distance from the reconstruction's samples to the true surface.
        accuracy_p95: 95th percentile of the same.
        completeness: mean distance from the truth's samples to the reconstructed surface.
        completeness_p95: 95th percentile of the same.
        normal_consistency: mean |n . n'| over nearest samples, both directions averaged, in [0, 1].
        f_score: harmonic mean of the shares of either side's samples within tau of the other surface.
        iou: volume of the intersection over that of the union; None unless both meshes are closed.
        cd_penalty: `cd` of a single point at the origin, which stands for a failed reconstruction.
        failed: the reconstruction has no surface. Everything but `floor` and `cd_penalty` is None then.
        vertices: count in the reconstruction.
        faces: count in the reconstruction.
        pieces: connected pieces of the reconstruction: beside the shape's own parts, crumbs that float.
    """

    cd: float | None
    floor: float
    excess: float | None
    cd_source: float | None
    point_to_surface: float | None
    accuracy: float | None
    accuracy_p95: float | None
    completeness: float | None
    completeness_p95: float | None
    normal_consistency: float | None
    f_score: float | None
    iou: float | None
    cd_penalty: float
    failed: bool
    vertices: int
    faces: int
    pieces: int


def judge(
    reconstruction: Mesh,
    truth: NormalizedMesh,
    points: int = 30_000,
    seed: int = 0,
    tau: float = 0.01,
) -> ShapeMetrics:
    """All metrics of a reconstruction against the true mesh.

    Args:
        reconstruction: vertices [V, 3] and faces [F, 3], normalised frame; F = 0 is a failure.
        truth: the mesh it should equal.
        points: samples on each side.
        seed: of all samples; the same seed gives the same judgement.
        tau: threshold of the F-score, normalised frame.
    """
    vertices = np.ascontiguousarray(reconstruction[0], np.float64)
    faces = np.ascontiguousarray(reconstruction[1], np.int64)
    want = sample_surface(truth.vertices, truth.faces, points, (seed, 0))
    again, _ = sample_surface(truth.vertices, truth.faces, points, (seed, 1))
    known = {
        "floor": chamfer(want[0], again),
        "cd_penalty": chamfer(np.zeros((1, 3)), want[0]),
        "vertices": len(vertices),
        "faces": len(faces),
        "pieces": piece_count(faces, len(vertices)),
    }
    if not np.abs(face_normals(vertices, faces)).sum() > 0:
        absent = {f.name: None for f in fields(ShapeMetrics) if f.name not in known}
        return ShapeMetrics(**known, **absent | {"failed": True})
    have = sample_surface(vertices, faces, points, (seed, 2))
    near = _sampled_metrics(have, want)
    exact = _surface_metrics(have[0], (vertices, faces), want[0], (truth.vertices, truth.faces), tau)
    return ShapeMetrics(
        **known,
        **near,
        **exact,
        excess=near["cd"] - known["floor"],
        cd_source=near["cd"] / float(truth.scale) ** 2,
        iou=volumetric_iou((vertices, faces), (truth.vertices, truth.faces), seed=seed),
        failed=False,
    )


@dataclass(frozen=True)
class Judge:
    """`judge` with its settings fixed, as a worker process is handed it.

    Args:
        points, seed: as in `judge`.
    """

    points: int
    seed: int

    def __call__(self, pair: tuple[Mesh, NormalizedMesh]) -> ShapeMetrics:
        """The judgement of a reconstruction against the true mesh."""
        return judge(*pair, points=self.points, seed=self.seed)


def sample_surface(
    vertices: np.ndarray, faces: np.ndarray, count: int, seed: int | tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Independent points on a mesh, uniform by area.

    Args:
        vertices: [V, 3], any frame.
        faces: [F, 3] rows of `vertices`.
        count: n, the number of points.
        seed: of the generator.

    Returns:
        points [n, 3] float64, and the unit normals [n, 3] float64 of their faces, outward as the faces are.

    Raises:
        ValueError: the mesh has no area.
    """
    rng = np.random.default_rng(seed)
    normals = face_normals(vertices, faces)
    cumulative = np.cumsum(np.linalg.norm(normals, axis=1))
    if not (len(cumulative) and cumulative[-1] > 0):
        raise ValueError("faces: the mesh has no area to sample")
    total = cumulative[-1]
    chosen = np.searchsorted(cumulative, rng.random(count) * total, side="right")
    chosen = np.minimum(chosen, np.searchsorted(cumulative, total))  # rounding may step past the last area
    a, b, c = np.moveaxis(vertices[faces[chosen]], 1, 0)
    u, v = rng.random((2, count, 1))
    fold = u + v > 1  # the far half of the parallelogram, turned back onto the triangle
    u, v = np.where(fold, 1 - u, u), np.where(fold, 1 - v, v)
    normals = normals[chosen]
    return a + u * (b - a) + v * (c - a), normals / np.linalg.norm(normals, axis=1, keepdims=True)


def chamfer(a: np.ndarray, b: np.ndarray) -> float:
    """Mean squared nearest distance from a to b plus that from b to a.

    Source: Fan et al., A Point Set Generation Network, 2017, with means for sums.

    Args:
        a: [N, 3], N > 0.
        b: [M, 3], M > 0, in the same frame.
    """
    forth, _ = _nearest(a, b)
    back, _ = _nearest(b, a)
    return float(np.mean(forth**2) + np.mean(back**2))


def volumetric_iou(a: Mesh, b: Mesh, count: int = IOU_POINTS, seed: int = 0) -> float | None:
    """Volume inside both meshes over volume inside either, from uniform points in their joint bounding box.

    A point is inside where the winding number is positive.

    Args:
        a, b: vertices and faces in one frame.
        count: points; the standard error is about sqrt(iou (1 - iou) / points in the union).
        seed: of the points.

    Returns:
        In [0, 1], or None where a mesh is open, or both are empty.
    """
    if not (is_closed(*a) and is_closed(*b)):
        return None
    corners = np.concatenate([mesh[0][mesh[1].ravel()] for mesh in (a, b)])
    low, high = corners.min(axis=0), corners.max(axis=0)
    points = np.random.default_rng(seed).uniform(low, high, (count, 3))
    inside = [closed_winding_numbers(*mesh, points) > 0 for mesh in (a, b)]
    union = np.count_nonzero(inside[0] | inside[1])
    return float(np.count_nonzero(inside[0] & inside[1]) / union) if union else None


def is_closed(vertices: np.ndarray, faces: np.ndarray) -> bool:
    """Whether every edge is used as often in one direction as in the other: winding numbers are whole then.

    Vertices at the same place count as one.
    """
    if not len(faces):
        return False
    if _edges_cancel(faces):
        return True
    _, place = np.unique(vertices, axis=0, return_inverse=True)
    return _edges_cancel(place.reshape(-1)[faces])


def _edges_cancel(faces: np.ndarray) -> bool:
    start, end = faces.ravel(), faces[:, [1, 2, 0]].ravel()
    up, size = start < end, int(faces.max()) + 1
    rising = np.sort(start[up] * size + end[up])
    falling = np.sort((end * size + start)[start > end])
    return np.array_equal(rising, falling)


def summarize(rows: list[ShapeMetrics]) -> dict:
    """Mean, median and 90th percentile of every metric over a set of shapes, failures counted beside them.

    Returns:
        `shapes`, `failed`, `failures` (how failures enter, in words), `cd_mean_with_failures` and
        `cd_median_with_failures`, and per metric a dict of `mean`, `median`, `p90` and `count`, the number of
        shapes that have it; the three are None where none has.
    """
    with_failures = [row.cd_penalty if row.failed else row.cd for row in rows]
    summary = {
        "shapes": len(rows),
        "failed": sum(row.failed for row in rows),
        "failures": FAILURES,
        "cd_mean_with_failures": float(np.mean(with_failures)) if rows else None,
        "cd_median_with_failures": float(np.median(with_failures)) if rows else None,
    }
    succeeded = [row for row in rows if not row.failed]
    for name in (f.name for f in fields(ShapeMetrics) if f.name not in ("failed", "cd_penalty")):
        values = [v for v in (getattr(row, name) for row in succeeded) if v is not None]
        summary[name] = _statistics(values)
    return summary


def _statistics(values: list[float]) -> dict[str, float | int | None]:
    if not values:
        return {"mean": None, "median": None, "p90": None, "count": 0}
    mean, median, p90 = np.mean(values), np.median(values), np.percentile(values, 90)
    return {"mean": float(mean), "median": float(median), "p90": float(p90), "count": len(values)}


def _sampled_metrics(have: Mesh, want: Mesh) -> dict[str, float]:
    """What two sets of points and normals say: Chamfer distance and normal consistency."""
    forth, partner = _nearest(have[0], want[0])
    back, origin = _nearest(want[0], have[0])
    agree = [
        np.abs(np.einsum("ij,ij->i", have[1], want[1][partner])).mean(),
        np.abs(np.einsum("ij,ij->i", want[1], have[1][origin])).mean(),
    ]
    cd = np.mean(forth**2) + np.mean(back**2)
    return {"cd": float(cd), "normal_consistency": float(np.mean(agree))}


def _surface_metrics(
    have: np.ndarray, mesh: Mesh, want: np.ndarray, truth: Mesh, tau: float
) -> dict[str, float]:
    """What exact distances from samples to the other surface say: no noise floor in any of them."""
    forth, back = point_to_surface(have, *truth), point_to_surface(want, *mesh)
    precision, recall = np.mean(forth < tau), np.mean(back < tau)
    values = {
        "point_to_surface": (forth.mean() + back.mean()) / 2,
        "accuracy": forth.mean(),
        "accuracy_p95": np.percentile(forth, 95),
        "completeness": back.mean(),
        "completeness_p95": np.percentile(back, 95),
        "f_score": 2 * precision * recall / max(precision + recall, 1e-12),
    }
    return {name: float(value) for name, value in values.items()}


def point_to_surface(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Exact unsigned distance [N] from each of the points [N, 3] to the nearest point of any face."""
    order = _by_cell(points)
    squared, _, _ = igl.point_mesh_squared_distance(points[order], vertices, faces)
    distance = np.empty(len(points))
    distance[order] = np.sqrt(squared)
    return distance


def _nearest(queries: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance [N] to, and row [N] of, the nearest of `points` for each query."""
    order, kept = _by_cell(queries), _by_cell(points)
    distance, row = cKDTree(points[kept], balanced_tree=False).query(queries[order])
    back = np.argsort(order)
    return distance[back], kept[row[back]]


def _by_cell(points: np.ndarray, cells: int = 64) -> np.ndarray:
    """An order in which neighbours in space follow each other: trees answer it many times faster."""
    columns = np.ascontiguousarray(points.T)  # reductions over rows of three are slow
    low, high = columns.min(axis=1), columns.max(axis=1)
    cell = (columns - low[:, None]) * ((cells - 1) / max((high - low).max(), 1e-300))
    x, y, z = cell.astype(np.int64)
    return np.argsort((x * cells + y) * cells + z, kind="stable")
