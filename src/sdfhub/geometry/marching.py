"""Marching cubes at level 0 of values known only around the surface. Everything is in grid steps.

Source: Lewiner et al., Efficient Implementation of Marching Cubes' Cases with Topological Guarantees, 2003
(the triangles of a cell; scikit-image's implementation).
"""

import numpy as np
from skimage.measure import marching_cubes

EMPTY = np.empty((0, 3), np.float32), np.empty((0, 3), np.int32)


def march(volume: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and outward faces of [a, b, c] float32; empty where nothing crosses zero."""
    return marching_cubes(volume, 0.0)[:2] if volume.min() <= 0 < volume.max() else EMPTY


def march_cells(
    cells: np.ndarray, nodes: np.ndarray, values: np.ndarray, n: int
) -> tuple[np.ndarray, np.ndarray]:
    """Marching cubes over those cells alone on which the sign changes.

    Args:
        cells: [M] flat indices of their lowest nodes in a grid of n nodes per axis, x slowest.
        nodes, values: [K] flat indices of nodes, all corners of the cells among them, and float32 there.
    """
    if not len(cells):
        return EMPTY
    cells, nodes = _indices(cells, n), _indices(nodes, n)
    low, high = cells.min(axis=1), cells.max(axis=1) + 1  # only the box of the cells is marched
    is_within = np.logical_and.reduce((nodes >= low[:, None]) & (nodes <= high[:, None]))
    volume, mask = np.ones(high - low + 1, np.float32), np.zeros(high - low + 1, bool)
    volume[tuple(nodes[:, is_within] - low[:, None])] = values[is_within]
    mask[tuple(cells - low[:, None] + 1)] = True  # a cell is marked at its upper corner
    vertices, faces, _, _ = marching_cubes(volume, 0.0, mask=mask)
    return vertices + low.astype(np.float32), faces


def _indices(keys: np.ndarray, n: int) -> np.ndarray:
    """Indices [3, N] of flat keys; `np.unravel_index` is several times slower."""
    columns = keys // n
    i = columns // n
    return np.stack([i, columns - i * n, keys - columns * n])
