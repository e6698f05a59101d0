"""Marching cubes at level 0 of values known only around the surface. Everything is in grid steps.

Source: Lewiner et al., Efficient Implementation of Marching Cubes' Cases with Topological Guarantees, 2003
(the triangles of a cell; scikit-image's implementation).
"""

import numpy as np
from skimage.measure import marching_cubes

SLAB_NODES = 2**24
"""Nodes marched at a time: 64 MiB of values, whatever the resolution."""


def march(volume: np.ndarray, mask: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and outward faces; empty where nothing crosses zero.

    Args:
        volume: [a, b, c] float32.
        mask: bool, like `volume`: cells to march, each marked at its upper corner; None marches all.
    """
    empty = np.empty((0, 3), np.float32), np.empty((0, 3), np.int32)
    if not volume.min() <= 0 < volume.max():
        return empty
    try:
        vertices, faces, _, _ = marching_cubes(volume, 0.0, mask=mask)
    except RuntimeError:  # both signs occur, but in no marched cell together
        return empty
    return vertices, faces


def march_blocks(
    blocks: np.ndarray, nodes: np.ndarray, values: np.ndarray, n: int
) -> tuple[np.ndarray, np.ndarray]:
    """Marching cubes over the cells of some blocks, one slab of x at a time, joined to one mesh.

    Args:
        blocks: [C, 3]; block b covers the cells 2b and 2b + 1 of each axis that the grid has.
        nodes: [K] flat indices of nodes, x slowest; all nodes of the blocks are among them.
        values: [K] float32 at the nodes.
        n: nodes per axis.
    """
    if not len(blocks):
        return march(np.ones((2, 2, 2), np.float32))
    low = 2 * blocks.min(axis=0)  # only the box of the blocks is looked at
    high = np.minimum(2 * blocks.max(axis=0) + 2, n - 1)
    across = high[1:] - low[1:] + 1
    area = int(across.prod())
    depth = max(2, SLAB_NODES // area // 2 * 2)
    i, j, k = (index - lowest for index, lowest in zip(np.unravel_index(nodes, (n,) * 3), low, strict=True))
    places = (i * across[0] + j) * across[1] + k
    parts, count = [], 0
    for start in range(0, high[0] - low[0], depth):
        stop = min(start + depth, high[0] - low[0])
        inside = (places >= start * area) & (places < (stop + 1) * area)
        volume = np.ones((stop - start + 1, *across), np.float32)
        volume.reshape(-1)[places[inside] - start * area] = values[inside]
        vertices, faces = march(volume, _mask(2 * blocks - low - [start, 0, 0], volume.shape))
        parts.append((vertices + np.float32([start, 0, 0]), faces + count))
        count += len(vertices)
    vertices, faces = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    vertices, faces = _weld(vertices, faces, depth) if len(parts) > 1 else (vertices, faces)
    return vertices + low.astype(np.float32), faces


def _mask(low: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """The upper corners of the cells of blocks with first cells `low` [C, 3], as far as `shape` has them."""
    halves = np.zeros([-(-(size - 1) // 2) for size in shape], bool)
    halves[tuple((low[(low[:, 0] >= 0) & (low[:, 0] < shape[0] - 1)] // 2).T)] = True
    mask = np.zeros(shape, bool)
    cells = halves.repeat(2, 0).repeat(2, 1).repeat(2, 2)
    mask[1:, 1:, 1:] = cells[tuple(slice(size - 1) for size in shape)]
    return mask


def _weld(vertices: np.ndarray, faces: np.ndarray, period: int) -> tuple[np.ndarray, np.ndarray]:
    """One vertex where two slabs hold the same: made from the same values, it is equal bit by bit."""
    seam = np.flatnonzero(vertices[:, 0] % period == 0)
    _, first, place = np.unique(vertices[seam], axis=0, return_index=True, return_inverse=True)
    target = np.arange(len(vertices))
    target[seam] = seam[first][place]
    used, compact = np.unique(target, return_inverse=True)
    return vertices[used], compact[faces]
