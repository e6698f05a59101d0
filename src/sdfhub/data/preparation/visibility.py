"""Which faces of a mesh can be seen from outside, and from which of their sides.

Faces that no view sees are interior and dropped; faces seen mostly from their back are turned round; faces
seen from both sides are sheets without an inside.
"""

import os
from typing import NamedTuple

import igl
import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from sdfhub.data.preparation.settings import Preparation
from sdfhub.errors import RejectedMesh
from sdfhub.geometry.surface_sampling import points_on_faces, sphere_directions
from sdfhub.shapes import NormalizedMesh
from sdfhub.triangles import face_normals, piece_count

# Read by libigl's first call: shapes run in parallel, not points.
os.environ.setdefault("IGL_NUM_THREADS", "1")

FIRST, SECOND = 16, 48  # rays at every face in the first round, and at undecided ones in the second
RAYS = 1_500_000  # of a round above which a face gets fewer than that, down to half
LARGE = 200_000  # rays of the first round on top, shared out by area
AGAIN = 3  # times as many of these in the second
SURE = 0.12  # share of its rays that must reach a face, all on one side, to need no others (open: 0.5)
CHUNK = 50_000  # rays at once
BAD = 0.1  # share of sightings on its less seen side from which a face counts as bad
STEP = 1e-3  # distance from a face at which the winding number before and behind it is taken
SOLID = 0.8  # winding number above which the space behind a face counts as solid
TOUCH = 5e-6  # above a face: where a ray to the eye starts, so that a coincident face does not stop it


class Surface(NamedTuple):
    """The faces that bound a shape, oriented outwards, normalised frame."""

    vertices: np.ndarray  # [V, 3] float64
    faces: np.ndarray  # [F, 3] int64, counter-clockwise seen from outside
    two_sided: np.ndarray  # [F] bool, sheets seen from both sides: a distance, but no inside
    statistics: dict[str, float]  # about how the faces were found

    def solid(self) -> np.ndarray:
        """[S, 3] the faces that separate inside from outside."""
        return self.faces[~self.two_sided]


def sightings(mesh: NormalizedMesh, views: int, rng: np.random.Generator) -> np.ndarray:
    """[2, F] share of each face's counter-clockwise and other side that parallel views from all around see.

    An isolated face reaches about 0.5 on its outer side. Rays are aimed at points on the faces: a small one
    is then judged by as many as it needs. A first round looks at every face, large ones more often; a second
    at those seen too little, or from either side.
    """
    directions = rng.permutation(sphere_directions(views)).astype(np.float32)
    corners, normals = mesh.vertices.astype(np.float32)[mesh.faces], face_normals(mesh.vertices, mesh.faces)
    area = np.linalg.norm(normals, axis=1)
    normals = (normals / area[:, None]).astype(np.float32)
    turn = rng.integers(len(directions), size=len(area))  # a face takes one direction after the other
    front, back, cast = sums = np.zeros((3, len(area)))  # weighted by the cosine
    scene = EmbreeScene()
    TriangleMesh(scene, mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32))

    def look(faces: np.ndarray, rays: np.ndarray) -> None:  # [S] rows, and the number of rays for each
        starts = np.cumsum(rays) - rays
        row = np.repeat(turn[faces] - starts, rays) + np.arange(rays.sum())
        direction = directions[row % len(directions)]
        origins = points_on_faces(corners, np.repeat(faces, rays), rng) + np.float32(TOUCH) * direction
        cosine = np.einsum("nj,nj->n", np.repeat(normals[faces], rays, axis=0), direction)
        seen = np.where(scene.run(origins, direction, query="OCCLUDED") < 0, cosine, 0)
        weights = np.maximum(seen, 0), np.maximum(-seen, 0), np.abs(cosine)
        for total, weight in zip(sums, weights, strict=True):
            total[faces] += np.add.reduceat(weight, starts)
        turn[faces] += rays

    def look_in_chunks(faces: np.ndarray, rays: np.ndarray, most: int) -> None:
        rays = rays + int(np.clip(RAYS // len(faces), most // 2, most))
        ends = np.cumsum(rays)
        bounds = np.searchsorted(ends, np.arange(CHUNK, ends[-1], CHUNK))
        for chunk in np.split(np.arange(len(faces)), np.unique(bounds)):
            if len(chunk):
                look(faces[chunk], rays[chunk])

    large = (area / area.sum() * LARGE).astype(np.int64)
    look_in_chunks(np.arange(len(area)), large, FIRST)
    undecided = np.flatnonzero((front + back < SURE * cast) | (np.minimum(front, back) > 0))
    if len(undecided):
        look_in_chunks(undecided, AGAIN * large[undecided], SECOND)
    return sums[:2] / np.maximum(cast, 1e-12)


def visible_surface(mesh: NormalizedMesh, preparation: Preparation, rng: np.random.Generator) -> Surface:
    """The faces that are seen, each turned to the side that is seen most, sheets marked.

    Source: DeepSDF (Park et al. 2019), section 5: oriented points from what 100 virtual cameras see.
    DeepSDF's two gates hold for the vote alone, in which each sighting speaks for itself: a mesh that lacks
    2% of its faces fails them, while the winding number closes such holes and judges its own certainty.
    """
    front, back = sightings(mesh, preparation.views, rng)
    total, wrong, is_turned = front + back, np.minimum(front, back), back > front
    kept = total > preparation.hidden_below
    area = np.linalg.norm(face_normals(mesh.vertices, mesh.faces), axis=1)
    faces = np.where(is_turned[:, None], mesh.faces[:, ::-1], mesh.faces)
    two_sided = kept & (wrong > preparation.two_sided_above * total)
    two_sided[two_sided] = ~_bounds_a_solid(mesh.vertices, faces[kept], faces[two_sided])
    if not (kept & ~two_sided).any():
        raise RejectedMesh("two_sided_area", "no visible face has a single visible side")
    visible = np.where(kept, area, 0)
    statistics = {
        "hidden_area": float(area[~kept].sum() / area.sum()),
        "turned_area": float(area[kept & is_turned].sum() / area.sum()),
        "two_sided_area": float(visible[two_sided].sum() / visible.sum()),
        "contradictory": float((visible * wrong).sum() / (visible * total).sum()),
        "bad_faces": float((visible * (wrong > BAD * total)).sum() / visible.sum()),
    }
    for name in ("two_sided_area", "contradictory", "bad_faces")[: 3 if preparation.sign == "vote" else 1]:
        if statistics[name] > (limit := getattr(preparation, f"max_{name}")):
            raise RejectedMesh(name, f"{statistics[name]:.1%}, at most {limit:.0%} wanted")
    return Surface(mesh.vertices, np.ascontiguousarray(faces[kept]), two_sided[kept], statistics)


def _bounds_a_solid(vertices: np.ndarray, faces: np.ndarray, suspects: np.ndarray) -> np.ndarray:
    """[S] whether the winding number of all faces is near 1 behind a suspect and near 0 before it."""
    # so it is at a wall seen from within through a hole; at a sheet it is about 1/2 and -1/2
    normals = face_normals(vertices, suspects)
    step = STEP * normals / np.linalg.norm(normals, axis=1)[:, None]
    centre = vertices[suspects].mean(axis=1)
    tree = igl.FastWindingNumberBVH()
    tree.init(vertices, np.ascontiguousarray(faces), 2)
    return (tree.winding_number(centre - step) > SOLID) & (tree.winding_number(centre + step) < 1 - SOLID)


def closed_surface(mesh: NormalizedMesh) -> Surface | None:
    """All faces, if they form one closed, consistently oriented shell of positive volume; else None."""
    start, end = mesh.faces[:, [0, 1, 2]].ravel(), mesh.faces[:, [1, 2, 0]].ravel()
    forward, backward = (np.sort(a * len(mesh.vertices) + b) for a, b in ((start, end), (end, start)))
    if (np.diff(forward) == 0).any() or not np.array_equal(forward, backward):
        return None  # an edge without exactly two faces, or two faces that run along it the same way
    normals = face_normals(mesh.vertices, mesh.faces)
    volume = np.einsum("nj,nj->", mesh.vertices[mesh.faces[:, 0]], normals) / 6
    if volume <= 0 or piece_count(mesh.faces, len(mesh.vertices)) > 1:
        return None
    return Surface(mesh.vertices, mesh.faces, np.zeros(len(mesh.faces), bool), {"fast_path": 1.0})
