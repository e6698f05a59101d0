"""Which parts of a grid the zero level of a field can pass, from few evaluations, for many shapes at once.

A *cell* of stride s spans s grid steps; a *block* is a cell of stride 2, the finest thing that is skipped.
Cells and blocks are rows [shape, i, j, k]. A cell is judged at its *centre*, the node s / 2 steps above its
lowest corner, or the grid's last one. Slopes are per grid step: no length of the frame enters.

A cell whose centre has the value f cannot hold the surface while |f| > L * half diagonal, where L bounds the
slope of the field in it. Nothing about a network guarantees an L: those trained with clamped distances say
only "far" beyond the clamp, and may be steeper than 1 or nearly flat. So L is measured from the samples
around the cell, multiplied by a safety factor, and never below what the field shows near its surface. What
this still misses is grown back: wherever a sign change leaves the evaluated blocks, the neighbour is
evaluated too. So a connected piece of surface is found whole or not at all.
"""

import numpy as np
from scipy.ndimage import maximum_filter

from sdfhub.geometry.grid import Grid

_SMALL = 16  # below this many nodes per axis a coarse level says nothing
_NEAR = 0.05  # share of the coarse samples, those nearest to zero, that set the least slope
_CHILDREN = np.indices((1, 2, 2, 2)).reshape(4, 8).T
_SIDES = [(axis, step) for axis in range(3) for step in (-1, 1)]
_UNKNOWN, _INSIDE, _OUTSIDE = 0, 1, 2


def candidate_blocks(grid: Grid, coarse: int, safety: float) -> np.ndarray:
    """Blocks [C, 4] that may hold the surface, those of a shape together.

    Args:
        grid: of all shapes.
        coarse: cells per axis at the coarsest level, about: strides are powers of two.
        safety: factor on the measured slopes.
    """
    if grid.n <= _SMALL:
        return _cells(grid, 2)
    stride = 2 ** max(1, round(np.log2((grid.n - 1) / coarse)))
    cells, slope = _coarse_cells(grid, stride, safety)
    while stride > 2:
        stride //= 2
        cells, slope = _refine(grid, cells, slope, stride, safety)
    return cells


def evaluate_blocks(grid: Grid, blocks: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Values at the nodes of blocks, which grow until no sign change leaves them.

    Returns:
        the blocks [C, 4], their nodes' keys [K], each once and in no order, and the values [K] float32.
    """
    side = np.zeros(len(grid.shapes) * grid.n**3, np.int8)
    active = np.zeros((len(grid.shapes), *[_cells_per_axis(grid.n, 2)] * 3), bool)
    found = [(blocks[:0], np.empty(0, np.int64), np.empty(0, np.float32))]
    while len(blocks):
        active[tuple(blocks.T)] = True
        nodes = _nodes_of(blocks, grid.n)
        keys = _distinct(nodes[side[nodes] == _UNKNOWN])
        values = grid.evaluate(keys)
        side[keys] = np.where(values > 0, _OUTSIDE, _INSIDE)
        found.append((blocks, keys, values))
        blocks = _crossed_neighbours(active, blocks, side[nodes] == _OUTSIDE)
    return tuple(np.concatenate(arrays) for arrays in zip(*found, strict=True))


def _cells_per_axis(n: int, stride: int) -> int:
    return -(-(n - 1) // stride)


def _cells(grid: Grid, stride: int) -> np.ndarray:
    """All cells [C, 4] of a stride."""
    sizes = len(grid.shapes), *[_cells_per_axis(grid.n, stride)] * 3
    return np.indices(sizes).reshape(4, -1).T


def _centre_keys(grid: Grid, cells: np.ndarray, stride: int) -> np.ndarray:
    return grid.keys(cells * [1, stride, stride, stride] + [0, *[stride // 2] * 3])


def _coarse_cells(grid: Grid, stride: int, safety: float) -> tuple[np.ndarray, np.ndarray]:
    """The cells [C, 4] of the coarsest level that may hold the surface and their slope bounds [C]."""
    m = _cells_per_axis(grid.n, stride)
    values = grid.evaluate(_centre_keys(grid, _cells(grid, stride), stride)).reshape(-1, m, m, m)
    size, slope = np.abs(values), _slope(values, stride)
    bound = safety * np.stack([_least_slope(*pair) for pair in zip(size, slope, strict=True)])
    keep = _may_cross(size, bound, stride)
    return np.argwhere(keep), bound[keep]


def _least_slope(size: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Slopes [m, m, m] of a shape's cells: the steepest around each, and no less than near the surface."""
    near = slope[size <= np.quantile(size, _NEAR)]
    return np.maximum(maximum_filter(slope, 3), np.quantile(near, 0.9))


def _slope(values: np.ndarray, spacing: float) -> np.ndarray:
    """Per sample, the steepest differences to its neighbours along the last three axes, as a norm."""
    squares = np.zeros_like(values)
    for axis in (-3, -2, -1):
        steps = np.moveaxis(np.abs(np.diff(values, axis=axis)), axis, -1)
        largest = np.zeros((*steps.shape[:-1], steps.shape[-1] + 1), values.dtype)
        largest[..., :-1] = steps
        largest[..., 1:] = np.maximum(largest[..., 1:], steps)
        squares += np.moveaxis(largest, -1, axis) ** 2
    return np.sqrt(squares) / spacing


def _refine(
    grid: Grid, cells: np.ndarray, slope: np.ndarray, stride: int, safety: float
) -> tuple[np.ndarray, np.ndarray]:
    """Those children of the cells that may hold the surface, and their slope bounds; `stride` is theirs."""
    children = (cells[:, None] * [1, 2, 2, 2] + _CHILDREN).reshape(-1, 4)
    values = grid.evaluate(_centre_keys(grid, children, stride))
    siblings = _slope(values.reshape(-1, 2, 2, 2), stride).reshape(-1, 8).max(axis=1, initial=0)
    slope = np.repeat(np.maximum(slope, safety * siblings), 8)
    inside = (children[:, 1:] * stride < grid.n - 1).all(axis=1)
    keep = inside & _may_cross(np.abs(values), slope, stride)
    return children[keep], slope[keep]


def _may_cross(size: np.ndarray, slope: np.ndarray, stride: int) -> np.ndarray:
    return size <= slope * (stride * np.sqrt(3) / 2)


def _nodes_of(blocks: np.ndarray, n: int) -> np.ndarray:
    """Keys [C, 3, 3, 3] of the nodes of blocks; where a block leaves the grid, its last nodes again."""
    shape, *ijk = blocks.T
    i, j, k = (np.minimum(2 * index[:, None] + np.arange(3), n - 1) for index in ijk)
    plane = (shape[:, None] * n + i)[:, :, None] * n + j[:, None]
    return plane[..., None] * n + k[:, None, None]


def _distinct(keys: np.ndarray) -> np.ndarray:
    """Each key once, ascending: what `np.unique` does, 30 times faster on keys that repeat little."""
    keys = np.sort(keys)
    return keys[np.diff(keys, prepend=-1) > 0]


def _crossed_neighbours(active: np.ndarray, blocks: np.ndarray, outside: np.ndarray) -> np.ndarray:
    """Inactive blocks [C, 4] behind those faces of `blocks` on which the sign changes."""
    crossed = [blocks[:0]]
    for axis, step in _SIDES:
        face = outside.take(1 + step, axis=axis + 1).reshape(-1, 9)
        neighbours = blocks[face.any(axis=1) & ~face.all(axis=1)]
        neighbours[:, axis + 1] += step
        within = (neighbours[:, axis + 1] >= 0) & (neighbours[:, axis + 1] < active.shape[-1])
        crossed.append(neighbours[within])
    crossed = np.concatenate(crossed)
    return np.unique(crossed[~active[tuple(crossed.T)]], axis=0)
