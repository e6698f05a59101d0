"""Points on surfaces: random ones on a triangle mesh, uniform by area, and even ones on the unit sphere."""

import numpy as np

from sdfhub.triangles import face_normals


def sample_surface(
    vertices: np.ndarray, faces: np.ndarray, count: int, seed: int | tuple[int, ...] | np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Points [count, 3] on a mesh, face by face, and normals [count, 3]; a ValueError if it has no area."""
    rng = np.random.default_rng(seed)
    normals = face_normals(vertices, faces)
    area = np.linalg.norm(normals, axis=1)
    face = random_faces(area, count, rng)
    return points_on_faces(vertices[faces], face, rng), normals[face] / area[face, None]


def random_faces(area: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """[count] rows of faces in ascending order, each drawn in proportion to its area of [F]."""
    total = area.sum()
    if not total > 0:
        raise ValueError("faces: the mesh has no area to sample")
    return np.repeat(np.arange(len(area)), rng.multinomial(count, area / total))


def points_on_faces(corners: np.ndarray, face: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """[N, 3] a uniform point on each triangle named in `face`, [N] rows of `corners` [F, 3, 3]."""
    root = np.sqrt(rng.random(len(face), corners.dtype))
    third = root * rng.random(len(face), corners.dtype)
    corner = corners[face]
    edges = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    return (root - third)[:, None] * edges[0] + third[:, None] * edges[1] + corner[:, 0]


def sphere_directions(count: int) -> np.ndarray:
    """[count, 3] unit vectors spread evenly (a Fibonacci lattice); neighbours lie far apart in the order."""
    height = 1 - (2 * np.arange(count) + 1) / count
    turn = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    radius = np.sqrt(1 - height**2)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), height], axis=1)
