"""What a sensor's rays say about the space that they crossed."""

import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

RAYS = 4
"""Rays nearest to a place that must all have passed it."""


def free_space(
    points: np.ndarray, sensor: np.ndarray, cells: int, background: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Places that the sensor saw to be empty, and how far at least each is from any surface.

    A cell of the cube is free if the rays nearest to it, no further apart than rays are from each other,
    ended a cell behind it. Its distance to the nearest cell that is not free bounds that to any surface,
    seen or unseen.

    Args:
        points: [N, 3] where rays ended, normalised frame.
        sensor: [3] where they began.
        cells: along an axis of [-1, 1]^3.
        background: whether what no ray ended near is empty all along.

    Returns:
        centres [K, 3] of free cells and lower bounds [K] of the distance there, >= 0.
    """
    size = 2 / cells
    axis = -1 + size * (np.arange(cells) + 0.5)
    centres = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    rays, reached = _directions(points - sensor)
    towards, depth = _directions(centres - sensor)
    tree = cKDTree(rays)
    wide = 2 * np.median(tree.query(rays, 2)[0][:, 1])
    # a cell is as wide as its own rays: no other may end in it
    apart, near = tree.query(towards, RAYS, distance_upper_bound=float(max(wide, 0.02)))
    is_free = np.zeros(len(centres), bool)
    rows = np.flatnonzero(np.isfinite(apart).all(axis=1))
    is_free[rows] = depth[rows] < reached[near[rows]].min(axis=1) - size
    if background:
        is_free |= np.isinf(apart).all(axis=1)
    padded = np.pad(is_free.reshape((cells,) * 3), 1)  # nothing is known beyond the cube
    clear = distance_transform_edt(padded)[1:-1, 1:-1, 1:-1].ravel()[is_free]
    return centres[is_free], np.maximum(clear - np.sqrt(3), 0) * size


def _directions(vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    length = np.linalg.norm(vectors, axis=1)
    return vectors / np.maximum(length, 1e-12)[:, None], length
