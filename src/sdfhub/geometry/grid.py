"""Fields of many shapes seen at the nodes of one grid, evaluated in few large calls.

A node has a flat key: ((shape * n + i) * n + j) * n + k, for n nodes along each axis. Node i of an axis lies
at -bound + 2 * bound * i / (n - 1): both end points are included.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from sdfhub.errors import SdfhubError
from sdfhub.shapes import Mesh

Fields = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]
"""Maps points [B, N, 3] float32, normalised frame, and shapes [B] int64 to signed distances [B, N]."""

TILE = 1024
"""Points of one shape in a row of a call. Shapes need unequal numbers of points; cut into tiles, of which
only the last of a shape is filled up, they share a call without a code per point."""


@dataclass(frozen=True)
class Grid:
    """Where fields are evaluated, and how many points at a time.

    Args:
        fields: of all shapes.
        shapes: the shapes that are evaluated together; keys and arrays count them from 0.
        n: nodes per axis, >= 2.
        bound: half the edge of the cube, normalised frame.
        batch: points per call of `fields`; rounded down to whole tiles, at least one.
        device: where `fields` expects its arguments.
    """

    fields: Fields
    shapes: range
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

    @cached_property
    def axis(self) -> torch.Tensor:
        """Coordinates [n] of the nodes of an axis."""
        steps = torch.arange(self.n, dtype=torch.float64)
        return (steps * self.step - self.bound).float().to(self.device)

    @property
    def integers(self) -> type:
        """The smallest type that holds all keys: half the memory is most of the time spent on them."""
        return np.int32 if len(self.shapes) * self.n**3 < 2**31 else np.int64

    def evaluate(self, keys: np.ndarray) -> np.ndarray:
        """The fields [N] float32 at the nodes of keys [N]: a shape's together, shapes in order."""
        nodes = self.n**3
        first = np.searchsorted(keys, nodes * np.arange(len(self.shapes) + 1))
        place, shapes = _tiled(np.diff(first))
        tiles = np.zeros((len(shapes), TILE), np.int32 if nodes < 2**31 else np.int64)
        tiles.reshape(-1)[place] = keys - np.repeat(nodes * np.arange(len(self.shapes)), np.diff(first))
        values = np.empty(tiles.shape, np.float32)
        together = max(1, self.batch // TILE)
        for start in range(0, len(tiles), together):
            part = slice(start, start + together)
            values[part] = self._call(self._points(tiles[part]), shapes[part] + self.shapes.start)
        return values.reshape(-1)[place]

    def evaluate_points(self, points: torch.Tensor) -> np.ndarray:
        """The field [N] float32 of the first shape at points [N, 3], wherever they lie."""
        parts, shape = points.to(self.device).split(self.batch), np.array([self.shapes.start])
        return np.concatenate([self._call(part[None], shape)[0] for part in parts])

    def to_frame(self, vertices: np.ndarray, faces: np.ndarray) -> Mesh:
        """A mesh in grid steps as one in the normalised frame."""
        return Mesh(vertices.astype(np.float64) * self.step - self.bound, faces.astype(np.int64))

    def _points(self, tiles: np.ndarray) -> torch.Tensor:
        keys = torch.from_numpy(tiles).to(self.device)
        column = keys // self.n
        i = column // self.n
        return self.axis[torch.stack([i, column - i * self.n, keys - column * self.n], dim=-1)]

    @torch.no_grad()  # not inference_mode: tensors that a field caches must stay usable in training
    def _call(self, points: torch.Tensor, shapes: np.ndarray) -> np.ndarray:
        field = self.fields(points, torch.from_numpy(shapes).to(self.device))
        if field.shape != points.shape[:2]:
            wanted = list(points.shape[:2])
            raise ValueError(f"field: expected one value per point, {wanted}, got {list(field.shape)}")
        values = field.detach().float().cpu().numpy()
        if not np.isfinite(values).all():
            bad = np.count_nonzero(~np.isfinite(values))
            raise SdfhubError(f"field: {bad} of {values.size} values are not finite; did training diverge?")
        return values


def _tiled(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places [N] in a row of tiles of `counts` [S] items of each shape, and the shape [T] of each tile."""
    tiles = -(-counts // TILE)
    shift = TILE * (np.cumsum(tiles) - tiles) - (np.cumsum(counts) - counts)
    return np.arange(counts.sum()) + np.repeat(shift, counts), np.repeat(np.arange(len(counts)), tiles)
