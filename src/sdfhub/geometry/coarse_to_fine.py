"""Which parts of a grid the zero level of a field can pass, from few evaluations, for many shapes at once.

A *cell* of stride s spans s grid steps; a *block* is a cell of stride 2, the finest thing that is skipped.
Cells and blocks are rows [shape, i, j, k]. A cell is judged at its *centre*, the node s / 2 steps above its
lowest corner, or the grid's last one. Slopes are per grid step: no length of the frame enters.

A centre with the value f tells the sign of every node of its cell within |f| / L steps, where L bounds the
slope of the field in the cell; a cell whose nodes are all told is skipped. Of the blocks left, only nodes
that no block tells are evaluated, and those of cells on which the sign changes. Nothing about a network
guarantees an L: those trained with clamped distances say only "far" beyond the clamp, and may be steeper than
1 or nearly flat. So L is measured from the samples around the cell, multiplied by a safety factor, and never
below what the field shows near its surface. What this still misses is grown back: wherever a sign change
leaves the blocks, the neighbour joins them, and when a told sign proves wrong, all are looked at again. So a
connected piece of surface is found whole or not at all.
"""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter

from sdfhub.geometry.grid import Grid

_SMALL = 16  # below this many nodes per axis a coarse level says nothing
_NEAR = 0.05  # share of the coarse samples, those nearest to zero, that set the least slope
_CHILDREN = np.indices((1, 2, 2, 2)).reshape(4, 8).T
_SIDES = [(axis, step) for axis in range(3) for step in (-1, 1)]
_OUTSIDE, _TOLD, _EVALUATED = 1, 2, 4  # what is known of a node, as bits; 0: nothing


class Judged(NamedTuple):
    """Cells [C, 4] of one stride, the values [C] at their centres and bounds [C] on their slopes."""

    cells: np.ndarray
    values: np.ndarray
    slope: np.ndarray

    def candidates(self, stride: int) -> "Judged":
        """Those that may hold the surface."""
        keep = ~self.tells(stride * np.sqrt(3) / 2)
        return Judged(*(array[keep] for array in self))

    def tells(self, distance: float) -> np.ndarray:
        """Whether [C] nodes of the cell this many steps from its centre have the centre's sign."""
        return np.abs(self.values) > self.slope * distance


def judge_blocks(grid: Grid, coarse: int, safety: float) -> Judged:
    """The blocks that the coarser levels leave, those of a shape together.

    Args:
        grid: of all shapes.
        coarse: cells per axis at the coarsest level, about: strides are powers of two.
        safety: factor on the measured slopes.
    """
    if grid.n <= _SMALL:
        blocks = _cells(grid, 2)
        return Judged(blocks, grid.evaluate(_centre_keys(grid, blocks, 2)), np.full(len(blocks), np.inf))
    stride = 2 ** max(1, round(np.log2((grid.n - 1) / coarse)))
    judged = _coarse_cells(grid, stride, safety)
    while stride > 2:
        judged = _refine(grid, judged.candidates(stride), stride // 2, safety)
        stride //= 2
    return judged


def evaluate_crossed(grid: Grid, judged: Judged) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The cells of stride 1 on which the sign changes, and the values at their nodes.

    Args:
        grid: of all shapes.
        judged: blocks; those that may hold the surface grow until no sign change leaves them.

    Returns:
        keys [M] of the cells' lowest nodes; keys [K] of nodes, those of the cells among them, each once and
        in no order; and the values [K] float32.
    """
    blocks = judged.candidates(2).cells
    known, active = _told(grid, judged), np.zeros((len(grid.shapes), *[_cells_per_axis(grid.n, 2)] * 3), bool)
    samples, crossed = [(_centre_keys(grid, judged.cells, 2), judged.values)], [np.empty(0, grid.integers)]
    known[samples[0][0]] = _evaluated(judged.values)
    while len(blocks):
        active[tuple(blocks.T)] = True
        nodes = _nodes_of(blocks, grid.n)
        _evaluate(grid, nodes[known[nodes] == 0], known, samples)
        outside = (known[nodes] & _OUTSIDE) > 0
        marks = _crossed_cells(outside, blocks, grid.n)
        cells, surface = nodes[:, :2, :2, :2][marks], marks.any(axis=(1, 2, 3))
        corners = np.concatenate([cells + _distance(corner, grid.n) for corner in _CHILDREN[:, 1:]])
        if _evaluate(grid, corners, known, samples):
            blocks, crossed = np.argwhere(active).astype(grid.integers), crossed[:1]
        else:
            blocks = _crossed_neighbours(active, blocks[surface], outside[surface])
            crossed.append(cells)
    keys, values = (np.concatenate(arrays) for arrays in zip(*samples, strict=True))
    return np.concatenate(crossed), keys, values


def _told(grid: Grid, judged: Judged) -> np.ndarray:
    """What blocks say of all nodes of the grid, flat; those that leave the grid say nothing."""
    known = np.zeros(len(grid.shapes) * grid.n**3, np.int8)
    within = (2 * judged.cells[:, 1:] + 2 < grid.n).all(axis=1)
    judged = Judged(*(array[within] for array in judged))
    centres, told = _centre_keys(grid, judged.cells, 2), np.where(judged.values > 0, _TOLD | _OUTSIDE, _TOLD)
    for squared in (3, 2, 1):
        sure = judged.tells(np.sqrt(squared))
        near, signs = centres[sure], told[sure].astype(np.int8)
        for offset in np.argwhere(np.square(np.indices((3, 3, 3)) - 1).sum(axis=0) == squared) - 1:
            known[near + _distance(offset, grid.n)] = signs
    return known


def _distance(offset: np.ndarray, n: int) -> int:
    """What steps [3] along the axes add to a key."""
    return int(offset @ [n * n, n, 1])


def _cells_per_axis(n: int, stride: int) -> int:
    return -(-(n - 1) // stride)


def _cells(grid: Grid, stride: int) -> np.ndarray:
    """All cells [C, 4] of a stride."""
    sizes = len(grid.shapes), *[_cells_per_axis(grid.n, stride)] * 3
    return np.indices(sizes, grid.integers).reshape(4, -1).T


def _centre_keys(grid: Grid, cells: np.ndarray, stride: int) -> np.ndarray:
    shape, *ijk = cells.T
    i, j, k = (np.minimum(index * stride + stride // 2, grid.n - 1) for index in ijk)
    return ((shape * grid.n + i) * grid.n + j) * grid.n + k


def _coarse_cells(grid: Grid, stride: int, safety: float) -> Judged:
    """All cells of the coarsest level."""
    m = _cells_per_axis(grid.n, stride)
    cells = _cells(grid, stride)
    values = grid.evaluate(_centre_keys(grid, cells, stride)).reshape(-1, m, m, m)
    size, slope = np.abs(values), _slope(values, stride)
    bound = safety * np.stack([_least_slope(*pair) for pair in zip(size, slope, strict=True)])
    return Judged(cells, values.reshape(-1), bound.reshape(-1))


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


def _refine(grid: Grid, parents: Judged, stride: int, safety: float) -> Judged:
    """The children of the cells; `stride` is theirs."""
    first = parents.cells * np.array([1, 2, 2, 2], grid.integers)
    children = (first[:, None] + _CHILDREN.astype(grid.integers)).reshape(-1, 4)
    values = grid.evaluate(_centre_keys(grid, children, stride))
    siblings = _slope(values.reshape(-1, 2, 2, 2), stride).reshape(-1, 8).max(axis=1, initial=0)
    slope = np.repeat(np.maximum(parents.slope, safety * siblings), 8)
    within = (children[:, 1:] * stride < grid.n - 1).all(axis=1)
    return Judged(children[within], values[within], slope[within])


def _nodes_of(blocks: np.ndarray, n: int) -> np.ndarray:
    """Keys [C, 3, 3, 3] of the nodes of blocks; where a block leaves the grid, its last nodes again."""
    shape, *ijk = blocks.T
    i, j, k = (np.minimum(2 * index[:, None] + np.arange(3, dtype=index.dtype), n - 1) for index in ijk)
    plane = (shape[:, None] * n + i)[:, :, None] * n + j[:, None]
    return (plane * n)[..., None] + k[:, None, None]


def _evaluate(grid: Grid, keys: np.ndarray, known: np.ndarray, samples: list) -> bool:
    """Evaluates those nodes that are not yet. Does one prove to be other than it was told?"""
    keys = _distinct(keys[known[keys] < _EVALUATED])
    values = grid.evaluate(keys)
    before, after = known[keys], _evaluated(values)
    known[keys] = after
    samples.append((keys, values))
    return bool(((before != 0) & ((before ^ after) & _OUTSIDE > 0)).any())


def _evaluated(values: np.ndarray) -> np.ndarray:
    """What values say of their nodes."""
    return np.where(values > 0, _EVALUATED | _OUTSIDE, _EVALUATED).astype(np.int8)


def _crossed_cells(outside: np.ndarray, blocks: np.ndarray, n: int) -> np.ndarray:
    """The cells [C, 2, 2, 2] of blocks on which the sign changes, from what is outside [C, 3, 3, 3]."""
    some = every = outside
    for axis in (1, 2, 3):
        low, high = [slice(None)] * axis + [slice(2)], [slice(None)] * axis + [slice(1, 3)]
        some, every = some[tuple(low)] | some[tuple(high)], every[tuple(low)] & every[tuple(high)]
    crossed = some != every
    for axis in (1, 2, 3):
        np.moveaxis(crossed, axis, 1)[:, 1] &= (2 * blocks[:, axis] + 1 < n - 1)[:, None, None]
    return crossed


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
