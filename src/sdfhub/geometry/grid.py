"""Fields of many shapes seen at the nodes of one grid over [-1, 1]^3, evaluated in few large calls.

A node has a flat key: ((shape * n + i) * n + j) * n + k, for n nodes along each axis. Node i of an axis lies
at -1 + 2 * i / (n - 1): both end points are included.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch

from sdfhub.errors import SdfhubError
from sdfhub.shapes import Mesh

Fields = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]  # points [B, N, 3], shapes [B] -> [B, N]

TILE = 1024  # points of a shape in a row of a call: shapes need unequal numbers of them, and share calls


@dataclass(frozen=True)
class Grid:
    """Where fields are evaluated, and how many points at a time."""

    fields: Fields
    shapes: range  # those that are evaluated together; keys and arrays count them from 0
    n: int  # nodes per axis, >= 2
    batch: int  # points per call of `fields`; rounded down to whole tiles, at least one
    device: torch.device  # where `fields` expects its arguments

    @cached_property
    def axis(self) -> torch.Tensor:
        """Coordinates [n] of the nodes of an axis."""
        steps = torch.arange(self.n, dtype=torch.float64)
        return (steps * (2 / (self.n - 1)) - 1).float().to(self.device)

    @property
    def integers(self) -> type:
        """The smallest type that holds all keys: half the memory is most of the time spent on them."""
        return np.int32 if len(self.shapes) * self.n**3 < 2**31 else np.int64

    def evaluate(self, keys: np.ndarray) -> np.ndarray:
        """The fields [N] float32 at the nodes of keys [N]: a shape's together, shapes in order."""
        shapes = np.arange(len(self.shapes) + 1)
        first = np.searchsorted(keys, self.n**3 * shapes)
        counts = np.diff(first)
        tiles_each = -(-counts // TILE)
        shift = TILE * (np.cumsum(tiles_each) - tiles_each) - first[:-1]
        place, owner = np.arange(len(keys)) + np.repeat(shift, counts), np.repeat(shapes[:-1], tiles_each)
        tiles: np.ndarray = np.zeros((len(owner), TILE), self.integers)
        tiles.reshape(-1)[place] = keys - np.repeat(self.n**3 * shapes[:-1], counts)
        values = np.empty(tiles.shape, np.float32)
        together = max(1, self.batch // TILE)
        for start in range(0, len(tiles), together):
            part = slice(start, start + together)
            ijk = torch.stack(indices(torch.from_numpy(tiles[part]).to(self.device), self.n), dim=-1)
            values[part] = self.values_at(self.axis[ijk], owner[part] + self.shapes.start)
        return values.reshape(-1)[place]

    @torch.no_grad()  # not inference_mode: tensors that a field caches must stay usable in training
    def values_at(self, points: torch.Tensor, shapes: np.ndarray) -> np.ndarray:
        """The fields [B, N] float32 of shapes [B] at points [B, N, 3]; refuses values that are not finite."""
        field = self.fields(points, torch.from_numpy(shapes).to(self.device))
        if field.shape != points.shape[:2]:
            raise ValueError(f"field: expected {list(points.shape[:2])} values, got {list(field.shape)}")
        values = field.detach().float().cpu().numpy()
        if bad := np.count_nonzero(~np.isfinite(values)):
            raise SdfhubError(f"field: {bad} of {values.size} values are not finite; did training diverge?")
        return values

    def to_frame(self, vertices: np.ndarray, faces: np.ndarray) -> Mesh:
        """A mesh in grid steps as one in the normalised frame."""
        return Mesh(vertices.astype(np.float64) * (2 / (self.n - 1)) - 1, faces.astype(np.int64))


def indices(keys: Any, n: int) -> tuple[Any, Any, Any]:
    """i, j and k of keys, arrays or tensors; `np.unravel_index` is several times slower."""
    columns = keys // n
    i = columns // n
    return i, columns - i * n, keys - columns * n
