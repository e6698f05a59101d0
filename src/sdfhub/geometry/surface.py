"""Triangle meshes as surfaces: normals, pieces, random points; and even points on the unit sphere."""

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components


def face_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """[F, 3] normals, each as long as twice its triangle's area; counter-clockwise is outside."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return np.cross(b - a, c - a)


def piece_count(faces: np.ndarray, vertex_count: int) -> int:
    """Connected pieces: faces that share a vertex belong together, vertices without a face count nothing."""
    edges = faces[:, [0, 1, 1, 2]].reshape(-1, 2)
    graph = coo_matrix((np.ones(len(edges), bool), edges.T), shape=(vertex_count, vertex_count))
    return len(np.unique(connected_components(graph, directed=False)[1][faces[:, 0]]))


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
