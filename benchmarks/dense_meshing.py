"""The plain twin of `mesh_field`: every node of the grid is evaluated."""

import numpy as np
import torch
from skimage.measure import marching_cubes

from sdfhub.geometry.grid import Grid
from sdfhub.geometry.mesher import Field
from sdfhub.shapes import Mesh

TOGETHER = 2**20  # nodes whose keys are held at once


def mesh_dense(field: Field, resolution: int = 256) -> Mesh:
    """The zero level of a field of points [N, 3], normalised frame, V = F = 0 where it has none."""
    batch, nodes = 2**13 * torch.get_num_threads(), resolution**3
    fields = lambda points, _: field(points.flatten(0, 1)).unflatten(0, points.shape[:2])  # noqa: E731
    grid = Grid(fields, range(1), resolution, batch, torch.device("cpu"))
    keys = (np.arange(start, min(start + TOGETHER, nodes)) for start in range(0, nodes, TOGETHER))
    values = np.concatenate([grid.evaluate(part) for part in keys])
    if not values.min() <= 0 < values.max():
        return Mesh(np.empty((0, 3)), np.empty((0, 3), np.int64))
    return grid.to_frame(*marching_cubes(values.reshape((resolution,) * 3), 0.0)[:2])
