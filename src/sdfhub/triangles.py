"""What follows from a triangle mesh's arrays alone: vertices [V, 3] and faces [F, 3], in any frame."""

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components


def face_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """[F, 3] normals, each as long as twice its triangle's area; counter-clockwise is outside."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return np.cross(b - a, c - a)


def face_components(faces: np.ndarray, vertex_count: int) -> np.ndarray:
    """[F] label of each face's connected piece: faces that share a vertex share a label."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    graph = coo_matrix((np.ones(len(edges), bool), edges.T), shape=(vertex_count, vertex_count))
    return connected_components(graph, directed=False)[1][faces[:, 0]]


def piece_count(faces: np.ndarray, vertex_count: int) -> int:
    """Connected pieces of a mesh; vertices without a face are none."""
    return len(np.unique(face_components(faces, vertex_count)))
