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

Fields = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]
"""Maps points [B, N, 3] float32, normalised frame, and shapes [B] int64 to signed distances [B, N]."""

TILE = 1024
"""Points of one shape that travel together. Shapes need unequal numbers of points; cut into tiles, of which
only the last of a shape is filled up, they share a call without a code per point."""


@dataclass(frozen=True)
class Grid:
    """Where fields are evaluated, and how many points at a time.

    Args:
        fields: of all shapes.
        shapes: those that are looked at together; keys and arrays count them from 0.
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

    def keys(self, nodes: np.ndarray) -> np.ndarray:
        """Flat keys [N] of nodes [N, 4]: shape, i, j, k; those beyond the end of an axis are its last."""
        shape, *ijk = nodes.T
        i, j, k = np.minimum(ijk, self.n - 1)
        return ((shape * self.n + i) * self.n + j) * self.n + k

    def evaluate(self, keys: np.ndarray) -> np.ndarray:
        """The fields [N] float32 at the nodes of keys [N], where those of a shape stand together."""
        place, shapes = _tiled(keys // self.n**3)
        tiles = np.zeros((len(shapes), TILE), np.int64)
        tiles.reshape(-1)[place] = keys % self.n**3
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

    def to_frame(self, vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A mesh in grid steps as float64 vertices in the normalised frame and int64 faces."""
        return vertices.astype(np.float64) * self.step - self.bound, faces.astype(np.int64)

    def _points(self, keys: np.ndarray) -> torch.Tensor:
        keys = torch.from_numpy(keys).to(self.device)
        return self.axis[torch.stack([keys // self.n**2, keys // self.n % self.n, keys % self.n], dim=-1)]

    @torch.no_grad()  # not inference_mode: what a field caches must stay usable in training
    def _call(self, points: torch.Tensor, shapes: np.ndarray) -> np.ndarray:
        values = self.fields(points, torch.from_numpy(shapes).to(self.device))
        if values.shape != points.shape[:2]:
            want = list(points.shape[:2])
            raise ValueError(f"field: expected one value per point, {want}, got {list(values.shape)}")
        values = values.detach().float().cpu().numpy()
        if not np.isfinite(values).all():
            bad = np.count_nonzero(~np.isfinite(values))
            raise SdfhubError(f"field: {bad} of {values.size} values are not finite; did training diverge?")
        return values


def _tiled(shapes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places [N] of items in a row of tiles, given the shape [N] of each, and the shape [T] of every tile."""
    if not len(shapes):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    first = np.flatnonzero(np.diff(shapes, prepend=-1))
    count = np.diff(first, append=len(shapes))
    tiles = -(-count // TILE)
    shift = TILE * (np.cumsum(tiles) - tiles) - first
    return np.arange(len(shapes)) + np.repeat(shift, count), np.repeat(shapes[first], tiles)
