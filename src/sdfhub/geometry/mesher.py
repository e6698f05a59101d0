"""From fields to meshes: marching cubes at the zero level, dense or coarse to fine, one shape or many.

Grid: `resolution` nodes along each axis of the cube [-1, 1]^3, both end points included.

Source: Lewiner et al., Efficient Implementation of Marching Cubes' Cases with Topological Guarantees, 2003
(the triangles of a cell; scikit-image's implementation).
"""

from collections.abc import Callable, Iterator

import numpy as np
import torch
from skimage.measure import marching_cubes

from sdfhub.geometry.coarse_to_fine import evaluate_crossed_cells, sample_blocks
from sdfhub.geometry.grid import Fields, Grid
from sdfhub.shapes import Mesh

Field = Callable[[torch.Tensor], torch.Tensor]
"""Maps points [N, 3] float32, normalised frame, to signed distances [N], negative inside."""

_EMPTY = np.empty((0, 3), np.float32), np.empty((0, 3), np.int32)
_NODES_TOGETHER = 2**26  # nodes of all shapes that are meshed together, at one byte each; or one shape
_CACHED, _LARGE = 2**13, 2**20  # points per call: what the cache of one core keeps; what fills a GPU


def mesh_fields(
    fields: Fields,
    shapes: int,
    resolution: int = 256,
    batch: int | None = None,
    device: torch.device | str = "cpu",
) -> Iterator[Mesh]:
    """The zero levels of many fields as triangle meshes, evaluated coarse to fine, level by level together.

    A mesh equals that of `mesh_dense` but for connected pieces of surface that lie wholly in skipped cells.
    Where the surface leaves the cube the mesh is open. Shapes are meshed in groups, which bounds the memory.

    Args:
        fields: is asked for shapes 0 ... shapes - 1, in any order and repeated.
        shapes: how many: a mesh each, in order; empty where the field has no zero crossing.
        resolution: grid nodes per axis, >= 2.
        batch: points per call of `fields`; None chooses by device.
        device: where `fields` expects its points.
    """
    nodes = resolution**3
    together = max(1, _NODES_TOGETHER // nodes)
    for first in range(0, shapes, together):
        group = range(first, min(first + together, shapes))
        grid = _grid(fields, group, resolution, batch, device)
        cells, keys, values = evaluate_crossed_cells(grid, sample_blocks(grid))
        of_cell, of_key = cells // nodes, keys // nodes
        for shape in range(len(group)):
            own, held, offset = cells[of_cell == shape], of_key == shape, shape * nodes
            yield grid.to_frame(*_march_cells(own - offset, keys[held] - offset, values[held], resolution))


def mesh_field(field: Field, resolution: int = 256, device: torch.device | str = "cpu") -> Mesh:
    """The zero level of one field, which takes points [N, 3] alone: `mesh_fields` of one shape."""
    return next(mesh_fields(_as_fields(field), 1, resolution, device=device))


def mesh_dense(field: Field, resolution: int = 256, device: torch.device | str = "cpu") -> Mesh:
    """The zero level of one field, every node of the grid evaluated: the plain twin of `mesh_field`."""
    grid, nodes = _grid(_as_fields(field), range(1), resolution, None, device), resolution**3
    keys = (np.arange(start, min(start + _LARGE, nodes)) for start in range(0, nodes, _LARGE))
    values = np.concatenate([grid.evaluate(part) for part in keys])
    return grid.to_frame(*_march(values.reshape((resolution,) * 3)))


def sdf_slice(
    field: Field,
    axis: int = 1,
    offset: float = 0.0,
    resolution: int = 256,
    device: torch.device | str = "cpu",
) -> np.ndarray:
    """The field on a plane across `axis` (0, 1 or 2), `offset` from the origin, normalised frame.

    Returns:
        [resolution, resolution] float32, one index for each of the two axes left, in their order, both
        ascending; the outermost nodes lie on the cube's faces.
    """
    grid = _grid(_as_fields(field), range(1), resolution, None, device)
    plane = torch.cartesian_prod(grid.axis, grid.axis)
    at = torch.full_like(plane[:, :1], offset)
    points = torch.cat([plane[:, :axis], at, plane[:, axis:]], dim=1)
    parts = [grid.values_at(part[None], np.zeros(1, np.int64))[0] for part in points.split(grid.batch)]
    return np.concatenate(parts).reshape(resolution, resolution)


def _grid(
    fields: Fields, shapes: range, resolution: int, batch: int | None, device: torch.device | str
) -> Grid:
    device = torch.device(device)
    batch = batch or (_CACHED * torch.get_num_threads() if device.type == "cpu" else _LARGE)
    return Grid(fields, shapes, resolution, batch, device)


def _as_fields(field: Field) -> Fields:
    """A field of one shape as fields of a single one."""
    return lambda points, shapes: field(points.flatten(0, 1)).unflatten(0, points.shape[:2])


def _march(volume: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices, in grid steps, and outward faces of [n, n, n] float32; empty where nothing crosses zero."""
    return marching_cubes(volume, 0.0)[:2] if volume.min() <= 0 < volume.max() else _EMPTY


def _march_cells(
    cells: np.ndarray, nodes: np.ndarray, values: np.ndarray, n: int
) -> tuple[np.ndarray, np.ndarray]:
    """The same of cells alone, from nodes around the surface.

    Flat indices [M] of the cells' lowest nodes in a grid of n nodes per axis, x slowest, those [K] of nodes,
    all corners of the cells among them, and float32 values [K] there.
    """
    if not len(cells):
        return _EMPTY
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
