"""Which parts of a grid the zero level of a field can pass, from few evaluations, for many shapes at once.

A *cell* of stride s spans s grid steps; a *block* is a cell of stride 2, the finest thing that is skipped.
Cells are rows [shape, i, j, k], sampled at their *centres*, s / 2 steps above the lowest corner. Slopes are
per grid step. The state of a node is positive outside, negative inside, 0 where it is unknown.

A centre with the value f decides the sign of every node within |f| / L steps, where L bounds the slope of the
field in the cell; a cell whose nodes are all decided is skipped. Of the blocks left, only nodes that no block
decides are evaluated, and those of cells on which the sign changes. L is the steepest slope between samples
around the cell, times SAFETY, and never below the slopes near the surface: networks trained with clamped
distances may be steeper than 1 or nearly flat. Wherever a sign change leaves the blocks, the neighbour joins
them, and when an inferred sign proves wrong, all are evaluated again. So a connected piece of surface is
found whole or not at all.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter

from sdfhub.geometry.grid import Grid

COARSE = 32  # cells per axis at the coarsest level, about: strides are powers of two
SAFETY = 1.25  # factor on the measured slopes; a larger one misses less and evaluates more
_SMALL = 16  # below this many nodes per axis a coarse level says nothing
_NEAR = 0.05  # share of the coarse samples, those nearest to zero, that set the least slope
_CHILDREN = np.indices((1, 2, 2, 2)).reshape(4, 8).T
_INFERRED, _EVALUATED = 1, 2  # sizes of the states of nodes


class SampledCells(NamedTuple):
    """Cells [C, 4] of one stride, the values [C] at their centres and bounds [C] on their slopes."""

    cells: np.ndarray
    values: np.ndarray
    slope: np.ndarray

    def where(self, mask: Any) -> "SampledCells":
        return SampledCells(*(array[mask] for array in self))

    def candidates(self, stride: int) -> "SampledCells":
        return self.where(~self.decides(stride * np.sqrt(3) / 2))

    def decides(self, distance: float) -> np.ndarray:
        """[C] whether nodes of the cell this many steps from its centre surely have the centre's sign."""
        return np.abs(self.values) > self.slope * distance


def sample_blocks(grid: Grid) -> SampledCells:
    """The blocks in cells that coarser levels could not skip, those of a shape together."""
    stride = 2 if grid.n <= _SMALL else 2 ** max(1, round(np.log2((grid.n - 1) / COARSE)))
    m = -(-(grid.n - 1) // stride)
    cells = np.indices((len(grid.shapes), m, m, m), grid.integers).reshape(4, -1).T
    values = grid.evaluate(_centre_keys(cells, stride, grid.n))
    if grid.n <= _SMALL:
        return SampledCells(cells, values, np.full(len(cells), np.inf))
    fields = values.reshape(-1, m, m, m)
    sampled = SampledCells(cells, values, SAFETY * _slope_bounds(fields, stride).reshape(-1))
    while stride > 2:
        sampled = _refine(grid, sampled.candidates(stride), stride // 2)
        stride //= 2
    return sampled


def evaluate_crossed_cells(grid: Grid, sampled: SampledCells) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The cells of stride 1 on which the sign changes: candidates grow until no sign change leaves them.

    Keys [M] of the cells' lowest nodes; keys [K] of nodes, theirs among them, each once; values [K].
    """
    blocks = sampled.candidates(2).cells
    states = _inferred_states(grid, sampled)
    active = np.zeros((len(grid.shapes), *[grid.n // 2] * 3), bool)
    samples = [(_centre_keys(sampled.cells, 2, grid.n), sampled.values)]
    crossed: list[np.ndarray] = [np.empty(0, grid.integers)]
    states[samples[0][0]] = _states(sampled.values, _EVALUATED)
    while len(blocks):
        active[tuple(blocks.T)] = True
        nodes = _node_keys(blocks, 2, range(3), grid.n)
        _evaluate(grid, nodes[states[nodes] == 0], states, samples)
        outside = states[nodes] > 0
        marks = _crossed_cells(outside, nodes, grid.n)
        cells, surface = nodes[:, :2, :2, :2][marks], marks.any(axis=(1, 2, 3))
        corners = np.concatenate([cells + int(c @ [grid.n**2, grid.n, 1]) for c in _CHILDREN[:, 1:]])
        if _evaluate(grid, corners, states, samples):
            blocks, crossed = np.argwhere(active).astype(grid.integers), crossed[:1]
        else:
            blocks = _crossed_neighbours(active, blocks[surface], outside[surface])
            crossed.append(cells)
    keys, values = (np.concatenate(arrays) for arrays in zip(*samples, strict=True))
    return np.concatenate(crossed), keys, values


def _inferred_states(grid: Grid, sampled: SampledCells) -> np.ndarray:
    """States of all nodes of the grid, flat, inferred from the blocks that lie wholly within it."""
    states = np.zeros(len(grid.shapes) * grid.n**3, np.int8)
    sampled = sampled.where((2 * sampled.cells[:, 1:] + 2 < grid.n).all(axis=1))
    centres = _centre_keys(sampled.cells, 2, grid.n)
    inferred = _states(sampled.values, _INFERRED)
    offsets = np.indices((3, 3, 3)).reshape(3, -1).T - 1
    for squared in (3, 2, 1):
        sure = sampled.decides(np.sqrt(squared))
        near, signs = centres[sure], inferred[sure]
        for offset in offsets[np.square(offsets).sum(axis=1) == squared]:
            states[near + int(offset @ [grid.n**2, grid.n, 1])] = signs
    return states


def _node_keys(cells: np.ndarray, stride: int, steps: Sequence[int], n: int) -> np.ndarray:
    """Keys [C, S, S, S] of nodes `steps` [S] above cells' lowest corners, or of the grid's last nodes."""
    shape, *ijk = cells.T
    offsets = np.array(steps, cells.dtype)
    i, j, k = (np.minimum(stride * index[:, None] + offsets, n - 1) for index in ijk)
    plane = (shape[:, None] * n + i)[:, :, None] * n + j[:, None]
    return (plane * n)[..., None] + k[:, None, None]


def _centre_keys(cells: np.ndarray, stride: int, n: int) -> np.ndarray:
    return _node_keys(cells, stride, [stride // 2], n).reshape(-1)


def _slope_bounds(fields: np.ndarray, stride: int) -> np.ndarray:
    """[S, m, m, m] the steepest slope around a cell, and no less than near the shape's surface."""
    slopes = _slope(fields, stride)
    near = [slope[abs(f) <= np.quantile(abs(f), _NEAR)] for f, slope in zip(fields, slopes, strict=True)]
    least = np.array([np.quantile(slope, 0.9) for slope in near])[:, None, None, None]
    return np.maximum(maximum_filter(slopes, (1, 3, 3, 3)), least)


def _slope(values: np.ndarray, spacing: float) -> np.ndarray:
    """Per sample, the steepest differences to its neighbours along the last three axes, as a norm."""
    squares = np.zeros_like(values)
    for axis in (-3, -2, -1):
        moved = np.moveaxis(values, axis, 0)
        steps = np.abs(np.diff(moved, axis=0, prepend=moved[:1], append=moved[-1:]))
        squares += np.moveaxis(np.maximum(steps[:-1], steps[1:]), 0, axis) ** 2
    return np.sqrt(squares) / spacing


def _refine(grid: Grid, parents: SampledCells, stride: int) -> SampledCells:
    """The children of the cells; `stride` is theirs."""
    first = parents.cells * np.array([1, 2, 2, 2], grid.integers)
    children = (first[:, None] + _CHILDREN.astype(grid.integers)).reshape(-1, 4)
    values = grid.evaluate(_centre_keys(children, stride, grid.n))
    siblings = _slope(values.reshape(-1, 2, 2, 2), stride).reshape(-1, 8).max(axis=1, initial=0)
    slope = np.repeat(np.maximum(parents.slope, SAFETY * siblings), 8)
    return SampledCells(children, values, slope).where((children[:, 1:] * stride < grid.n - 1).all(axis=1))


def _evaluate(grid: Grid, keys: np.ndarray, states: np.ndarray, samples: list) -> bool:
    """Evaluates the nodes that are not yet; returns whether an inferred sign proves wrong."""
    keys = np.sort(keys[np.abs(states[keys]) < _EVALUATED])
    keys = keys[np.diff(keys, prepend=-1) > 0]  # np.unique is 30 times slower on keys that repeat little
    values = grid.evaluate(keys)
    before, after = states[keys], _states(values, _EVALUATED)
    states[keys] = after
    samples.append((keys, values))
    return bool((before * after < 0).any())


def _states(values: np.ndarray, size: int) -> np.ndarray:
    return np.where(values > 0, np.int8(size), np.int8(-size))


def _crossed_cells(outside: np.ndarray, nodes: np.ndarray, n: int) -> np.ndarray:
    """[C, 2, 2, 2] whether the sign changes on the cells of blocks with these nodes, `outside` or not."""
    some = every = outside  # of a cell's corners
    for axis in (1, 2, 3):
        low, high = (tuple([slice(None)] * axis + [slice(first, first + 2)]) for first in (0, 1))
        some, every = some[low] | some[high], every[low] & every[high]
    is_within = nodes[:, 1:, 1:, 1:] - nodes[:, :2, :2, :2] == n * n + n + 1  # no node comes twice
    return (some != every) & is_within


def _crossed_neighbours(active: np.ndarray, blocks: np.ndarray, outside: np.ndarray) -> np.ndarray:
    """Inactive blocks [C, 4] behind those faces of `blocks` on which the sign changes."""
    crossed = [blocks[:0]]
    for axis, step in [(axis, step) for axis in (1, 2, 3) for step in (-1, 1)]:
        face = outside.take(1 + step, axis=axis).reshape(-1, 9)
        neighbours = blocks[face.any(axis=1) & ~face.all(axis=1)]
        neighbours[:, axis] += step
        crossed.append(neighbours[(neighbours[:, axis] >= 0) & (neighbours[:, axis] < active.shape[-1])])
    behind = np.concatenate(crossed)
    return np.unique(behind[~active[tuple(behind.T)]], axis=0)
