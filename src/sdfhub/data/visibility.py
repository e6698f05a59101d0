"""Which faces of a mesh can be seen from outside, and from which of their sides.

What no view sees is interior and goes; what is seen mostly from its back is turned round; what is seen
from both sides is a sheet without an inside.
"""

import os
from dataclasses import dataclass

import igl
import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from sdfhub.data.normalize import face_components, face_normals
from sdfhub.data.preparation import Preparation
from sdfhub.errors import RejectedMesh
from sdfhub.shapes import NormalizedMesh

os.environ.setdefault(
    "IGL_NUM_THREADS", "1"
)  # read by libigl's first call: shapes run in parallel, not points

RAYS = 500_000
"""Rays for a whole mesh, shared out by area; every face gets a fair number on top."""
CHUNK = 250_000
FROM = 2.5
"""Distance from which rays are cast at a surface point; the mesh lies within the unit ball."""
BAD = 0.1
"""Share of sightings on its less seen side from which a face counts as bad."""
STEP = 1e-3
"""Distance from a face at which the winding number before and behind it is taken."""
SOLID = 0.8
"""Winding number above which the space behind a face counts as solid."""
TOUCH = 5e-6
"""A ray that stops this close to its target has seen it (a coincident face or a neighbour got in first)."""


@dataclass(frozen=True)
class Surface:
    """The faces that bound a shape, oriented outwards.

    Args:
        vertices: [V, 3] float64, normalised frame.
        faces: [F, 3] int64, counter-clockwise seen from outside.
        two_sided: [F] bool, sheets seen from both sides: a distance, but no inside.
        statistics: plain numbers about how the faces were found.
    """

    vertices: np.ndarray
    faces: np.ndarray
    two_sided: np.ndarray
    statistics: dict[str, float]

    def solid(self) -> np.ndarray:
        """[S, 3] the faces that separate inside from outside."""
        return self.faces[~self.two_sided]


@dataclass(frozen=True)
class Sightings:
    """How much of each face is seen, as a share of what an isolated face would be from all around.

    Args:
        front: [F] of the counter-clockwise side, in [0, 1]; an unoccluded side reaches about 0.5.
        back: [F] of the other side.
    """

    front: np.ndarray
    back: np.ndarray


def view_directions(count: int) -> np.ndarray:
    """[count, 3] unit vectors spread evenly over the sphere (a Fibonacci lattice)."""
    height = 1 - (2 * np.arange(count) + 1) / count
    turn = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    radius = np.sqrt(1 - height**2)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), height], axis=1)


def points_on_faces(corners: np.ndarray, face: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """[N, 3] a uniform point on each triangle named in `face`, [N] rows of `corners` [F, 3, 3]."""
    root, along = np.sqrt(rng.random(len(face))), rng.random(len(face))
    weights = np.stack([1 - root, root * (1 - along), root * along], axis=1)
    return np.einsum("nij,ni->nj", corners[face], weights)


def sightings(mesh: NormalizedMesh, views: int, rng: np.random.Generator) -> Sightings:
    """The share of each face's two sides that parallel views from all around see.

    Rays are aimed at points on the faces rather than spread over pictures: a small face is then judged by as
    many rays as it needs, and none is missed for falling between pixels.
    """
    corners = mesh.vertices[mesh.faces]
    normals = face_normals(mesh.vertices, mesh.faces)
    area = np.linalg.norm(normals, axis=1)
    normals = normals / area[:, None]
    scene = EmbreeScene()
    TriangleMesh(scene, mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32))

    count = len(mesh.faces)
    fair = int(np.clip(4 * RAYS / count, 16, 64))
    rays = fair + (area / area.sum() * RAYS).astype(np.int64)
    directions = rng.permutation(view_directions(views))
    start = rng.integers(views, size=count)
    first = np.concatenate([[0], np.cumsum(rays)])
    sums = np.zeros((3, count))  # front, back, cast
    for low in range(0, first[-1], CHUNK):
        ray = np.arange(low, min(low + CHUNK, first[-1]))
        face = np.searchsorted(first, ray, side="right") - 1
        direction = directions[(start[face] + ray - first[face]) % views]
        seen = _sees(scene, points_on_faces(corners, face, rng), direction, face)
        cosine = np.einsum("nj,nj->n", normals[face], direction)
        for row, weight in enumerate(
            (seen * np.maximum(cosine, 0), seen * np.maximum(-cosine, 0), abs(cosine))
        ):
            sums[row] += np.bincount(face, weight, count)
    return Sightings(*(sums[:2] / np.maximum(sums[2], 1e-12)))


def _sees(scene: EmbreeScene, points: np.ndarray, direction: np.ndarray, face: np.ndarray) -> np.ndarray:
    origins = (points + FROM * direction).astype(np.float32)
    hit = scene.run(origins, (-direction).astype(np.float32), output=True)
    return (hit["primID"] == face) | (np.abs(hit["tfar"] - FROM) < TOUCH)


def visible_surface(mesh: NormalizedMesh, preparation: Preparation, rng: np.random.Generator) -> Surface:
    """The faces that are seen, each turned to the side that is seen most, sheets marked.

    Source: DeepSDF (Park et al. 2019), section 5: oriented points from what 100 virtual cameras see.

    DeepSDF's two gates hold for the vote alone, in which each sighting speaks for itself: a mesh that lacks
    2% of its faces fails them, while the winding number closes such holes and judges its own certainty.

    Raises:
        RejectedMesh: too much of it are sheets, or too many sightings contradict each other.
    """
    seen = sightings(mesh, preparation.views, rng)
    total = seen.front + seen.back
    wrong = np.minimum(seen.front, seen.back)
    kept = total > preparation.hidden_below
    area = np.linalg.norm(face_normals(mesh.vertices, mesh.faces), axis=1)
    faces = np.where((seen.back > seen.front)[:, None], mesh.faces[:, ::-1], mesh.faces)
    two_sided = kept & (wrong > preparation.two_sided_above * total)
    two_sided[two_sided] = ~_bounds_a_solid(mesh.vertices, faces[kept], faces[two_sided])
    if not (kept & ~two_sided).any():
        raise RejectedMesh(
            "two_sided_area", "no visible face has a single visible side, so nothing has an inside"
        )
    visible = np.where(kept, area, 0)
    statistics = {
        "hidden_area": float(area[~kept].sum() / area.sum()),
        "turned_area": float(area[kept & (seen.back > seen.front)].sum() / area.sum()),
        "two_sided_area": float(visible[two_sided].sum() / visible.sum()),
        "contradictory": float((visible * wrong).sum() / (visible * total).sum()),
        "bad_faces": float((visible * (wrong > BAD * total)).sum() / visible.sum()),
    }
    for name in ("two_sided_area", *(("contradictory", "bad_faces") if preparation.sign == "vote" else ())):
        limit = getattr(preparation, f"max_{name}")
        if statistics[name] > limit:
            raise RejectedMesh(name, f"{statistics[name]:.1%}, at most {limit:.0%} wanted")
    return Surface(mesh.vertices, np.ascontiguousarray(faces[kept]), two_sided[kept], statistics)


def _bounds_a_solid(vertices: np.ndarray, faces: np.ndarray, suspects: np.ndarray) -> np.ndarray:
    """[S] whether the winding number of all faces is near 1 behind a suspect and near 0 before it.

    A wall seen from within through a hole looks two-sided, but behind it the number is nearly 1. Behind a
    sheet it is about 1/2, before it -1/2.
    """
    normals = face_normals(vertices, suspects)
    step = STEP * normals / np.linalg.norm(normals, axis=1)[:, None]
    centre = vertices[suspects].mean(axis=1)
    tree = igl.FastWindingNumberBVH()
    tree.init(vertices, np.ascontiguousarray(faces), 2)
    return (tree.winding_number(centre - step) > SOLID) & (tree.winding_number(centre + step) < 1 - SOLID)


def closed_surface(mesh: NormalizedMesh) -> Surface | None:
    """All faces, if they form one closed, consistently oriented shell of positive volume; else None."""
    edges = mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    forward = edges[:, 0] * len(mesh.vertices) + edges[:, 1]
    backward = edges[:, 1] * len(mesh.vertices) + edges[:, 0]
    forward.sort()
    backward.sort()
    if (np.diff(forward) == 0).any() or not np.array_equal(forward, backward):
        return None  # an edge without exactly two faces, or two faces that run along it the same way
    volume = (
        np.einsum("nj,nj->", mesh.vertices[mesh.faces[:, 0]], face_normals(mesh.vertices, mesh.faces)) / 6
    )
    if volume <= 0 or np.ptp(face_components(mesh.faces, len(mesh.vertices))) > 0:
        return None
    return Surface(mesh.vertices, mesh.faces, np.zeros(len(mesh.faces), bool), {"fast_path": 1.0})
