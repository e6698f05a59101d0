"""Normals and connected pieces of a triangle mesh: vertices [V, 3] and faces [F, 3], in any frame."""

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
