"""From fields to meshes: marching cubes at the zero level, coarse to fine, one shape or many.

Source: Lewiner et al., Efficient Implementation of Marching Cubes' Cases with Topological Guarantees, 2003
(the triangles of a cell; scikit-image's implementation).
"""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
from skimage.measure import marching_cubes

from sdfhub.geometry.coarse_to_fine import evaluate_crossed_cells, sample_blocks
from sdfhub.geometry.grid import Fields, Grid, indices
from sdfhub.shapes import Mesh

Field = Callable[[torch.Tensor], torch.Tensor]  # points [N, 3] float32 -> signed distances [N]

Device = torch.device | str
_NODES_TOGETHER = 2**26  # nodes of all shapes that are meshed together, at one byte each; or one shape
_CACHED, _LARGE = 2**13, 2**20  # points per call: what the cache of one core keeps; what fills a GPU


def mesh_fields(
    fields: Fields, shapes: int, resolution: int = 256, batch: int | None = None, device: Device = "cpu"
) -> Iterator[Mesh]:
    """The zero levels of many fields as triangle meshes, evaluated coarse to fine, level by level together.

    `fields` is asked for shapes 0 ... shapes - 1 on `device`, in any order and repeated, for `batch` points a
    call (None chooses by device). A mesh equals that of the whole grid but for connected pieces of surface
    wholly in skipped cells; it is open where the surface leaves the cube, empty where there is none.
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


def mesh_field(field: Field, resolution: int = 256, device: Device = "cpu") -> Mesh:
    """The zero level of one field, which takes points [N, 3] alone: `mesh_fields` of one shape."""
    return next(mesh_fields(_as_fields(field), 1, resolution, device=device))


def sdf_slice(
    field: Field, axis: int = 1, offset: float = 0.0, resolution: int = 256, device: Device = "cpu"
) -> np.ndarray:
    """The field [resolution, resolution] float32 on a plane across `axis`, `offset` from the origin.

    Normalised frame; one index for each of the two axes left, in their order, both ascending.
    """
    grid = _grid(_as_fields(field), range(1), resolution, None, device)
    plane = torch.cartesian_prod(grid.axis, grid.axis)
    at = torch.full_like(plane[:, :1], offset)
    points = torch.cat([plane[:, :axis], at, plane[:, axis:]], dim=1)
    parts = [grid.values_at(part[None], np.zeros(1, np.int64))[0] for part in points.split(grid.batch)]
    return np.concatenate(parts).reshape(resolution, resolution)


def _grid(fields: Fields, shapes: range, resolution: int, batch: int | None, device: Device) -> Grid:
    device = torch.device(device)
    batch = batch or (_CACHED * torch.get_num_threads() if device.type == "cpu" else _LARGE)
    return Grid(fields, shapes, resolution, batch, device)


def _as_fields(field: Field) -> Fields:
    return lambda points, shapes: field(points.flatten(0, 1)).unflatten(0, points.shape[:2])


def _march_cells(cells: np.ndarray, nodes: np.ndarray, values: np.ndarray, n: int) -> tuple[Any, Any]:
    """Vertices in grid steps and faces of cells [M], keys of lowest nodes, from values [K] at nodes [K]."""
    if not len(cells):
        return np.empty((0, 3)), np.empty((0, 3))
    cells, nodes = np.stack(indices(cells, n)), np.stack(indices(nodes, n))
    low, high = cells.min(axis=1), cells.max(axis=1) + 1  # only the box of the cells is marched
    is_within = np.logical_and.reduce((nodes >= low[:, None]) & (nodes <= high[:, None]))
    volume, mask = np.ones(high - low + 1, np.float32), np.zeros(high - low + 1, bool)
    volume[tuple(nodes[:, is_within] - low[:, None])] = values[is_within]
    mask[tuple(cells - low[:, None] + 1)] = True  # a cell is marked at its upper corner
    vertices, faces, _, _ = marching_cubes(volume, 0.0, mask=mask)
    return vertices + low.astype(np.float32), faces
