"""Marching cubes at level 0 of values known only around the surface. Everything is in grid steps.

Source: Lewiner et al., Efficient Implementation of Marching Cubes' Cases with Topological Guarantees, 2003
(the triangles of a cell; scikit-image's implementation).
"""

import numpy as np
from skimage.measure import marching_cubes

SLAB_NODES = 2**24  # nodes marched at a time: 64 MiB of values, whatever the resolution
EMPTY = np.empty((0, 3), np.float32), np.empty((0, 3), np.int32)


def march(volume: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and outward faces of [a, b, c] float32; empty where nothing crosses zero."""
    return marching_cubes(volume, 0.0)[:2] if volume.min() <= 0 < volume.max() else EMPTY


def march_cells(
    cells: np.ndarray, nodes: np.ndarray, values: np.ndarray, n: int
) -> tuple[np.ndarray, np.ndarray]:
    """Marching cubes over cells on which the sign changes, one slab of x at a time, joined to one mesh.

    Args:
        cells: [M] flat indices of their lowest nodes in a grid of n nodes per axis, x slowest.
        nodes, values: [K] flat indices of nodes, all corners of the cells among them, and float32 there.
    """
    if not len(cells):
        return EMPTY
    cells, nodes = _indices(cells, n), _indices(nodes, n)
    low, high = cells.min(axis=1), cells.max(axis=1) + 1  # only the box of the cells is marched
    within = np.logical_and.reduce((nodes >= low[:, None]) & (nodes <= high[:, None]))
    size, values = high - low + 1, values[within]
    strides = np.array([size[1] * size[2], size[2], 1])
    uppers, places = strides @ (cells - low[:, None] + 1), strides @ (nodes[:, within] - low[:, None])
    depth = max(2, SLAB_NODES // int(strides[0]))
    parts, count = [], 0
    for start in range(0, size[0] - 1, depth):
        shape = min(depth, size[0] - 1 - start) + 1, *size[1:]
        first, end = start * strides[0], (start + shape[0]) * strides[0]
        volume, mask = np.ones(shape, np.float32), np.zeros(shape, bool)
        held = (places >= first) & (places < end)
        volume.reshape(-1)[places[held] - first] = values[held]
        mask.reshape(-1)[uppers[(uppers >= first + strides[0]) & (uppers < end)] - first] = True
        if mask.any():  # a cell is marked at its upper corner
            vertices, faces, _, _ = marching_cubes(volume, 0.0, mask=mask)
            parts.append((vertices + np.array([start, 0, 0], np.float32), faces + count))
            count += len(vertices)
    vertices, faces = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    vertices, faces = _weld(vertices, faces, depth) if len(parts) > 1 else (vertices, faces)
    return vertices + low.astype(np.float32), faces


def _indices(keys: np.ndarray, n: int) -> np.ndarray:
    """Indices [3, N] of flat keys; `np.unravel_index` is several times slower."""
    columns = keys // n
    i = columns // n
    return np.stack([i, columns - i * n, keys - columns * n])


def _weld(vertices: np.ndarray, faces: np.ndarray, period: int) -> tuple[np.ndarray, np.ndarray]:
    """Merges the vertices that two slabs share: made from the same values, they are equal bit by bit."""
    seam = np.flatnonzero(vertices[:, 0] % period == 0)
    _, first, place = np.unique(vertices[seam], axis=0, return_index=True, return_inverse=True)
    target = np.arange(len(vertices))
    target[seam] = seam[first][place]
    used, compact = np.unique(target, return_inverse=True)
    return vertices[used], compact[faces]
