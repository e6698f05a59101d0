"""From a field to a mesh: marching cubes at the zero level, dense or coarse to fine.

Grid: `resolution` nodes along each axis of the cube [-bound, bound]^3, both end points included: node i lies
at -bound + 2 * bound * i / (resolution - 1). A *cell* of stride s spans s grid steps; a *block* is a cell of
stride 2, the finest thing that is skipped. Slopes are per grid step: no length of the frame enters.

Coarse to fine: a cell whose centre has the value f cannot hold the surface while |f| > L * half diagonal,
where L bounds the slope of the field in it. Nothing about a network guarantees an L: those trained with
clamped distances say only "far" beyond the clamp, and may be steeper than 1 or nearly flat. So L is measured
from the samples around the cell, multiplied by a safety factor, and never below what the field shows near its
surface. What this still misses is grown back: wherever a sign change leaves the evaluated blocks, the
neighbour is evaluated too. So a connected piece of surface is found whole or not at all.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import maximum_filter
from skimage.measure import marching_cubes

from sdfhub.errors import SdfhubError

Field = Callable[[torch.Tensor], torch.Tensor]
Mesh = tuple[np.ndarray, np.ndarray]

_SMALL = 16  # below this many nodes per axis a coarse level says nothing
_SLAB_NODES = 2**24  # nodes marched at a time: 64 MiB of values, whatever the resolution
_NEAR = 0.05  # share of the coarse samples, those nearest to zero, that set the least slope
_CHILDREN = np.indices((2, 2, 2)).reshape(3, 8).T
_NODES = np.indices((3, 3, 3)).reshape(3, 27).T
_SIDES = [(axis, step) for axis in range(3) for step in (-1, 1)]


def mesh_field(
    field: Field,
    resolution: int = 256,
    bound: float = 1.0,
    coarse: int | None = 32,
    batch: int = 2**18,
    safety: float = 1.5,
    device: torch.device | str | None = None,
) -> Mesh:
    """The zero level of a field as a triangle mesh, evaluated coarse to fine.

    Equals `mesh_dense` except for connected pieces of surface that lie wholly in cells judged empty. Where
    the surface leaves the cube the mesh is open.

    Source: Lewiner et al., Efficient Implementation of Marching Cubes' Cases with Topological Guarantees,
    2003 (the triangles of a cell).

    Args:
        field: maps points [N, 3] float32, normalised frame, to signed distances [N], negative inside.
        resolution: grid nodes per axis, >= 2.
        bound: half the edge of the cube, normalised frame.
        coarse: cells per axis at the coarsest level, about: strides are powers of two. None evaluates all.
        batch: points per call of `field`.
        safety: factor on the measured slopes; larger misses less and evaluates more.
        device: where `field` expects its points; by default that of its parameters, else the CPU.

    Returns:
        vertices [V, 3] float64, normalised frame, and faces [F, 3] int64, counter-clockwise seen from
        outside. Both are empty where the field has no zero crossing.

    Raises:
        SdfhubError: the field returned values that are not finite.
    """
    if coarse is None or resolution <= _SMALL:
        return mesh_dense(field, resolution, bound, batch, device)
    grid = _Grid(field, resolution, bound, batch, _device_of(field, device))
    active = _active_blocks(grid, coarse, safety)
    keys, values = _evaluate_blocks(grid, active)
    return grid.to_frame(*_march_slabs(active, keys, values, resolution))


def mesh_dense(
    field: Field,
    resolution: int = 256,
    bound: float = 1.0,
    batch: int = 2**18,
    device: torch.device | str | None = None,
) -> Mesh:
    """The zero level of a field as a triangle mesh, every node of the grid evaluated: the plain twin.

    Args, Returns, Raises: as for `mesh_field`.
    """
    grid = _Grid(field, resolution, bound, batch, _device_of(field, device))
    values = grid.evaluate_keys(np.arange(resolution**3)).reshape((resolution,) * 3)
    return grid.to_frame(*_march(values))


def sdf_slice(
    field: Field,
    axis: int = 1,
    offset: float = 0.0,
    resolution: int = 256,
    bound: float = 1.0,
    batch: int = 2**18,
    device: torch.device | str | None = None,
) -> np.ndarray:
    """The field on a plane across one axis.

    Args:
        field: as for `mesh_field`.
        axis: 0, 1 or 2, the axis that the plane is perpendicular to.
        offset: the plane's coordinate on that axis, normalised frame.
        resolution: R, nodes per side; the outermost lie on the cube's faces.
        bound, batch, device: as for `mesh_field`.

    Returns:
        [R, R] float32, one index for each of the two axes left, in their order, both ascending.
    """
    grid = _Grid(field, resolution, bound, batch, _device_of(field, device))
    index = np.full((resolution**2, 3), (offset + bound) / grid.step)
    index[:, [a for a in range(3) if a != axis]] = np.indices((resolution, resolution)).reshape(2, -1).T
    return grid.evaluate(index).reshape(resolution, resolution)


@dataclass(frozen=True)
class _Grid:
    """A field seen at grid indices instead of points."""

    field: Field
    n: int
    bound: float
    batch: int
    device: torch.device

    def __post_init__(self):
        if self.n < 2:
            raise SdfhubError(f"resolution: {self.n} nodes per axis make no cell; use at least 2")

    @property
    def step(self) -> float:
        return 2 * self.bound / (self.n - 1)

    def evaluate(self, index: np.ndarray) -> np.ndarray:
        """The field at [N, 3] indices, whole or fractional, as [N] float32."""
        values = np.empty(len(index), np.float32)
        for start in range(0, len(index), self.batch):
            part = slice(start, start + self.batch)
            points = torch.from_numpy((index[part] * self.step - self.bound).astype(np.float32))
            values[part] = self._call(points)
        return values

    def evaluate_keys(self, keys: np.ndarray) -> np.ndarray:
        """The field at nodes given by their flat index, x slowest."""
        values = np.empty(len(keys), np.float32)
        for start in range(0, len(keys), self.batch):  # [N, 3] indices of a dense grid would not fit
            part = slice(start, start + self.batch)
            values[part] = self.evaluate(np.stack(np.unravel_index(keys[part], (self.n,) * 3), axis=1))
        return values

    @torch.no_grad()  # not inference_mode: what a field caches must stay usable in training
    def _call(self, points: torch.Tensor) -> np.ndarray:
        values = self.field(points.to(self.device))
        if values.shape != points.shape[:1]:
            raise ValueError(f"field: expected [{len(points)}] values, got {list(values.shape)}")
        values = values.detach().float().cpu().numpy()
        if not np.isfinite(values).all():
            bad = np.count_nonzero(~np.isfinite(values))
            raise SdfhubError(f"field: {bad} of {len(values)} values are not finite; did training diverge?")
        return values

    def to_frame(self, vertices: np.ndarray, faces: np.ndarray) -> Mesh:
        return vertices.astype(np.float64) * self.step - self.bound, faces.astype(np.int64)


def _device_of(field: Field, device: torch.device | str | None) -> torch.device:
    if device is None and isinstance(field, torch.nn.Module):
        device = next((p.device for p in field.parameters()), None)
    return torch.device(device or "cpu")


def _march(volume: np.ndarray, mask: np.ndarray | None = None) -> Mesh:
    """Marching cubes in index coordinates, outward faces; empty where nothing crosses zero."""
    empty = np.empty((0, 3), np.float32), np.empty((0, 3), np.int32)
    if not volume.min() <= 0 < volume.max():
        return empty
    try:
        vertices, faces, _, _ = marching_cubes(volume, 0.0, mask=mask)
    except RuntimeError:  # both signs occur, but in no marched cell together
        return empty
    return vertices, faces


def _centres(cells: np.ndarray, stride: int, n: int) -> np.ndarray:
    """Grid indices of the centres of cells; the last cell of an axis ends with the grid."""
    low = np.minimum(cells * stride, n - 1)
    return (low + np.minimum(low + stride, n - 1)) / 2


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


def _active_blocks(grid: _Grid, coarse: int, safety: float) -> np.ndarray:
    """[m, m, m] bool: the blocks of 2^3 grid cells that may hold the surface."""
    stride = 2 ** max(1, round(np.log2((grid.n - 1) / coarse)))
    cells, slope = _coarse_cells(grid, stride, safety)
    while stride > 2:
        stride //= 2
        cells, slope = _refine(grid, cells, slope, stride, safety)
    active = np.zeros((-(-(grid.n - 1) // 2),) * 3, bool)
    active[tuple(cells.T)] = True
    return active


def _coarse_cells(grid: _Grid, stride: int, safety: float) -> tuple[np.ndarray, np.ndarray]:
    """The cells [C, 3] of the coarsest level that may hold the surface and their slope bounds [C]."""
    m = -(-(grid.n - 1) // stride)
    cells = np.indices((m, m, m)).reshape(3, -1).T
    values = grid.evaluate(_centres(cells, stride, grid.n)).reshape(m, m, m)
    slope = _slope(values, stride)
    size = np.abs(values)
    near = slope[size <= np.quantile(size, _NEAR)]
    bound = safety * np.maximum(maximum_filter(slope, 3), np.quantile(near, 0.9))
    keep = _may_cross(size, bound, stride)
    return np.argwhere(keep), bound[keep]


def _refine(
    grid: _Grid, cells: np.ndarray, slope: np.ndarray, stride: int, safety: float
) -> tuple[np.ndarray, np.ndarray]:
    """Those children of the cells that may hold the surface, and their slope bounds; `stride` is theirs."""
    children = (2 * cells[:, None] + _CHILDREN).reshape(-1, 3)
    values = grid.evaluate(_centres(children, stride, grid.n))
    siblings = _slope(values.reshape(-1, 2, 2, 2), stride).reshape(-1, 8).max(axis=1, initial=0)
    slope = np.repeat(np.maximum(slope, safety * siblings), 8)
    inside = (children * stride < grid.n - 1).all(axis=1)
    keep = inside & _may_cross(np.abs(values), slope, stride)
    return children[keep], slope[keep]


def _may_cross(size: np.ndarray, slope: np.ndarray, stride: int) -> np.ndarray:
    return size <= slope * (stride * np.sqrt(3) / 2)


def _evaluate_blocks(grid: _Grid, active: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values at the nodes of the active blocks, which grow (in place) until no sign change leaves them.

    Returns:
        keys [K] int64, flat node indices in ascending order, and their values [K] float32.
    """
    blocks = np.argwhere(active)
    found = []
    while len(blocks):
        nodes = np.minimum(2 * blocks[:, None] + _NODES, grid.n - 1)
        keys, place = np.unique(nodes @ [grid.n**2, grid.n, 1], return_inverse=True)
        values = grid.evaluate_keys(keys)
        found.append((keys, values))
        blocks = _crossed_neighbours(active, blocks, (values > 0)[place].reshape(-1, 3, 3, 3))
        active[tuple(blocks.T)] = True
    if not found:
        return np.empty(0, np.int64), np.empty(0, np.float32)
    keys, first = np.unique(np.concatenate([k for k, _ in found]), return_index=True)
    return keys, np.concatenate([v for _, v in found])[first]


def _crossed_neighbours(active: np.ndarray, blocks: np.ndarray, outside: np.ndarray) -> np.ndarray:
    """Inactive blocks [C, 3] behind those faces of `blocks` on which the sign changes."""
    crossed = [np.empty((0, 3), np.int64)]
    for axis, step in _SIDES:
        face = outside.take(1 + step, axis=axis + 1).reshape(-1, 9)
        mixed = face.any(axis=1) & ~face.all(axis=1)
        neighbours = blocks[mixed]
        neighbours[:, axis] += step
        within = (neighbours[:, axis] >= 0) & (neighbours[:, axis] < len(active))
        crossed.append(neighbours[within])
    crossed = np.concatenate(crossed)
    crossed = crossed[~active[tuple(crossed.T)]]
    return np.unique(crossed, axis=0) if len(crossed) else crossed


def _march_slabs(active: np.ndarray, keys: np.ndarray, values: np.ndarray, n: int) -> Mesh:
    """Marching cubes over the cells of the active blocks, one slab of x at a time, joined to one mesh."""
    depth = max(1, _SLAB_NODES // (2 * n * n))
    parts, count = [], 0
    for start in range(0, len(active), depth):
        blocks = active[start : start + depth]
        low, high = 2 * start, min(2 * (start + len(blocks)), n - 1)
        part = slice(*np.searchsorted(keys, [low * n * n, (high + 1) * n * n]))
        volume = np.ones((high - low + 1, n, n), np.float32)
        volume.reshape(-1)[keys[part] - low * n * n] = values[part]
        mask = np.zeros(volume.shape, bool)  # a cell is marked at its upper corner
        mask[1:, 1:, 1:] = blocks.repeat(2, 0).repeat(2, 1).repeat(2, 2)[: high - low, : n - 1, : n - 1]
        vertices, faces = _march(volume, mask)
        parts.append((vertices + np.float32([low, 0, 0]), faces + count))
        count += len(vertices)
    vertices, faces = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return _weld(vertices, faces, 2 * depth) if len(parts) > 1 else (vertices, faces)


def _weld(vertices: np.ndarray, faces: np.ndarray, period: int) -> Mesh:
    """One vertex where two slabs hold the same: made from the same values, it is equal bit by bit."""
    seam = np.flatnonzero(vertices[:, 0] % period == 0)
    _, first, place = np.unique(vertices[seam], axis=0, return_index=True, return_inverse=True)
    target = np.arange(len(vertices))
    target[seam] = seam[first][place]
    used, compact = np.unique(target, return_inverse=True)
    return vertices[used], compact[faces]
