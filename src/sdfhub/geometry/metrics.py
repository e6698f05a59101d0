"""How good a reconstructed mesh is: Chamfer distance, its noise floor, and what Chamfer misses.

Lengths are in units of the meshes' common frame, the normalised one unless a name says `source`, Chamfer
distances in their squares; nothing is multiplied by 10^3 here. Two samplings of one surface differ by the
*noise floor*, which grows with area and falls with the number of points.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from functools import partial
from typing import Any

import igl
import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from sdfhub.geometry.morton import morton_order
from sdfhub.geometry.surface import face_normals, piece_count, sample_surface
from sdfhub.geometry.triangle_tree import TriangleTree
from sdfhub.shapes import Mesh, NormalizedMesh

TAU = 0.01  # distance within which a sample counts for the F-score
STATISTICS: dict[str, Any] = {"mean": np.mean, "median": np.median, "p90": partial(np.percentile, q=90)}


@dataclass(frozen=True)
class ShapeMetrics:
    """The judgement of one reconstruction; None where a value does not exist."""

    cd: float | None  # mean squared nearest distance between samples, both directions added
    floor: float  # `cd` of two independent samplings of the ground truth
    excess: float | None  # cd - floor; below 0 by chance where a reconstruction is as good as the truth
    cd_source: float | None  # `cd` in squared units of the source's own frame
    point_to_surface: float | None  # mean of `accuracy` and `completeness`
    accuracy: float | None  # mean distance from the reconstruction's samples to the true surface
    accuracy_p95: float | None  # and its 95th percentile
    completeness: float | None  # the same from the truth's samples to the reconstructed surface
    completeness_p95: float | None
    normal_consistency: float | None  # mean |n . n'| of nearest samples, both directions averaged, in [0, 1]
    f_score: float | None  # harmonic mean of the shares of samples within TAU of the other surface
    iou: float | None  # volume of the intersection over that of the union; None unless both meshes are closed
    cd_penalty: float  # `cd` of a single point at the origin, which stands for a failed reconstruction
    failed: bool  # no surface: everything but `floor`, `cd_penalty` and the counts is None then
    vertices: int  # of the reconstruction
    faces: int
    pieces: int  # connected, crumbs among them


def judge(reconstruction: Mesh, truth: NormalizedMesh, points: int = 30_000, seed: int = 0) -> ShapeMetrics:
    """All metrics of a reconstruction, normalised frame, by `points` samples a side."""
    mesh = Mesh(*map(np.ascontiguousarray, reconstruction, (np.float64, np.int64)))
    true_mesh = Mesh(truth.vertices, truth.faces)
    expected, true_normals = sample_surface(*true_mesh, points, (seed, 0))
    values: dict[str, Any] = dict.fromkeys(field.name for field in fields(ShapeMetrics))
    values |= {
        "floor": chamfer(expected, sample_surface(*true_mesh, points, (seed, 1))[0]),
        "cd_penalty": chamfer(np.zeros((1, 3)), expected),
        "vertices": len(mesh.vertices),
        "faces": len(mesh.faces),
        "pieces": piece_count(mesh.faces, len(mesh.vertices)),
        "failed": not np.abs(face_normals(*mesh)).sum() > 0,
    }
    if values["failed"]:
        return ShapeMetrics(**values)
    samples, normals = sample_surface(*mesh, points, (seed, 2))
    (there, partner), (back, origin) = _nearest(samples, expected), _nearest(expected, samples)
    pairs = (normals, true_normals[partner]), (true_normals, normals[origin])
    cosines = [np.abs(np.einsum("ij,ij->i", *pair)).mean() for pair in pairs]
    cd = float(np.mean(there**2) + np.mean(back**2))
    values |= {"cd": cd, "excess": cd - values["floor"], "cd_source": cd / float(truth.frame.scale) ** 2}
    values |= {"normal_consistency": float(np.mean(cosines)), "iou": volumetric_iou(mesh, true_mesh, seed)}
    # exact distances of samples to the other surface have no noise floor
    to_truth, to_mesh = point_to_surface(samples, *true_mesh), point_to_surface(expected, *mesh)
    for name, distances in (("accuracy", to_truth), ("completeness", to_mesh)):
        values |= {name: float(distances.mean()), f"{name}_p95": float(np.percentile(distances, 95))}
    precision, recall = float(np.mean(to_truth < TAU)), float(np.mean(to_mesh < TAU))
    values["point_to_surface"] = (values["accuracy"] + values["completeness"]) / 2
    values["f_score"] = 2 * precision * recall / max(precision + recall, 1e-12)
    return ShapeMetrics(**values)


def chamfer(a: np.ndarray, b: np.ndarray) -> float:
    """Mean squared nearest distance from points a [N, 3] to b [M, 3] plus that from b to a.

    Source: Fan et al., A Point Set Generation Network, 2017, with means for sums.
    """
    return float(np.mean(_nearest(a, b)[0] ** 2) + np.mean(_nearest(b, a)[0] ** 2))


def volumetric_iou(a: Mesh, b: Mesh, seed: int = 0, count: int = 20_000) -> float | None:
    """Volume inside both meshes over that inside either, by `count` points in their box; None if one is open.

    Source: Barill et al., Fast Winding Numbers for Soups and Clouds, 2018.
    """
    if not (is_closed(*a) and is_closed(*b)):
        return None
    corners = np.concatenate([mesh[0][mesh[1].ravel()] for mesh in (a, b)])
    low, high = corners.min(axis=0), corners.max(axis=0)
    points = np.random.default_rng(seed).uniform(low, high, (count, 3))
    points = points[morton_order(points)]
    inside = [igl.fast_winding_number(*mesh, points) > 0.5 for mesh in (a, b)]
    union = (inside[0] | inside[1]).sum()
    return float((inside[0] & inside[1]).sum() / union) if union else None


def is_closed(vertices: np.ndarray, faces: np.ndarray) -> bool:
    """Whether every edge is used as often one way as the other, vertices at the same place counted as one."""
    if not len(faces) or _edges_cancel(faces):
        return bool(len(faces))
    _, place = np.unique(vertices, axis=0, return_inverse=True)
    return _edges_cancel(place.reshape(-1)[faces])


def _edges_cancel(faces: np.ndarray) -> bool:
    edges = faces.ravel(), faces[:, [1, 2, 0]].ravel()
    uses = csr_array((np.ones(faces.size, np.int32), edges), shape=2 * (faces.max() + 1,))
    return not (uses - uses.T).count_nonzero()


@dataclass(frozen=True)
class DistanceMetrics:
    """The judgement of a field where the source has no mesh."""

    sdf_error: float  # mean |f - d| over samples with |d| < delta, normalised units
    sign_accuracy: float  # share of samples on the right side


def summarize(metrics: Sequence[ShapeMetrics | DistanceMetrics]) -> dict[str, Any]:
    """Statistics of every metric over a set of shapes, and the `count` of shapes that have it."""
    summary: dict[str, Any] = {"shapes": len(metrics)}
    rows = [row for row in metrics if isinstance(row, ShapeMetrics)]
    if len(rows) == len(metrics):
        words = "one point at the origin in the statistics with_failures, left out of all others"
        summary |= {"failed": sum(row.failed for row in rows), "failures": words}
        with_failures = [row.cd_penalty if row.cd is None else row.cd for row in rows]
        for name in ("mean", "median"):
            summary[f"cd_{name}_with_failures"] = float(STATISTICS[name](with_failures)) if rows else None
    plain = [asdict(row) for row in metrics if not getattr(row, "failed", False)]
    kind: Any = metrics[0] if metrics else ShapeMetrics
    for name in [field.name for field in fields(kind) if field.name not in ("failed", "cd_penalty")]:
        values = [row[name] for row in plain if row[name] is not None]
        statistics = {key: float(of(values)) if values else None for key, of in STATISTICS.items()}
        summary[name] = statistics | {"count": len(values)}
    return summary


def point_to_surface(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Exact unsigned distance [N] from each of the points [N, 3] to the nearest point of any face."""
    order, distance = morton_order(points), np.empty(len(points))
    distance[order] = TriangleTree(vertices[faces]).nearest(points[order])[0]
    return distance


def _nearest(queries: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance [N] to, and row [N] of, the nearest of `points` for each query."""
    order, tree_order = morton_order(queries), morton_order(points)
    distance, row = cKDTree(points[tree_order], balanced_tree=False).query(queries[order])
    back = np.argsort(order)
    return distance[back], tree_order[row[back]]
