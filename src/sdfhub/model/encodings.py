"""Positional encodings gamma(x): points [..., 3] in the unit ball become features [..., F].

A rival is a module with an attribute `features` (F) and a `forward` that can be differentiated twice, because
the normal loss differentiates the field's spatial gradient by the weights. It may also state its Jacobian
(`with_pullback`, autograd's by default).
"""

import math
from abc import ABC, abstractmethod
from typing import Annotated

import torch
from pydantic import Field, PositiveFloat, PositiveInt
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from sdfhub.described import Described
from sdfhub.model.derivatives import Pullback, value_and_pullback

PRIMES = (1, 2_654_435_761, 805_459_861)  # factors of the spatial hash: Mueller et al. 2022, section 3


class Encoding(Described, nn.Module, ABC):
    """A map from points to features."""

    features: int  # F, the number of features of a point

    @abstractmethod
    def forward(self, points: Tensor) -> Tensor:
        """Encodes points [..., 3], normalised frame, as [..., F]."""

    def with_pullback(self, points: Tensor) -> tuple[Tensor, Pullback]:
        """Features [..., F] and the map of a cotangent v [..., F] to J(x)^T v [..., 3], differentiable."""
        return value_and_pullback(self, points)

    def plain(self) -> "Encoding":
        """The encoding as tensor operations, with the same weights: itself, unless it is a faster twin."""
        return self


class OfModule(Encoding):
    """A module from points [..., 3] to features [..., F], with an attribute `features`, as an encoding."""

    def __init__(self, module: nn.Module, features: int):
        super().__init__()
        self.module, self.features = module, features

    def forward(self, points: Tensor) -> Tensor:
        return self.module(points)


def as_encoding(module: nn.Module) -> Encoding:
    """An encoding itself, or a module as one; raises a ValueError where it has no integer `features`."""
    if isinstance(module, Encoding):
        return module
    features = getattr(module, "features", None)
    if not isinstance(module, nn.Module) or not isinstance(features, int):
        raise ValueError("encoding must be a torch.nn.Module with an integer attribute `features`")
    return OfModule(module, features)


class Identity(Encoding):
    """The coordinates themselves: F = 3."""

    features = 3

    def forward(self, points: Tensor) -> Tensor:
        return points

    def with_pullback(self, points: Tensor) -> tuple[Tensor, Pullback]:
        return points, lambda cotangent: cotangent


class Fourier(Encoding):
    """sin(2^k pi x) and cos(2^k pi x) for k = 0 ... frequencies - 1, per axis: F = 6 frequencies (+ 3).

    x itself comes first where `include_points`.

    Source: Mildenhall et al. 2020, equation 4; the paper's "FFT".
    """

    octaves: Tensor

    def __init__(self, frequencies: PositiveInt, include_points: bool = False):
        super().__init__()
        self.include_points = include_points
        self.features = 6 * frequencies + 3 * include_points
        self.register_buffer("octaves", math.pi * 2.0 ** torch.arange(frequencies), persistent=False)

    def forward(self, points: Tensor) -> Tensor:
        angles = (points[..., None] * self.octaves).flatten(-2)
        waves = [torch.sin(angles), torch.cos(angles)]
        return torch.cat([points, *waves] if self.include_points else waves, dim=-1)

    def with_pullback(self, points: Tensor) -> tuple[Tensor, Pullback]:
        features = self(points)
        first = 3 * self.include_points
        sine, cosine = features[..., first:].chunk(2, dim=-1)

        def pullback(cotangent: Tensor) -> Tensor:
            by_sine, by_cosine = cotangent[..., first:].chunk(2, dim=-1)
            by_angles = by_sine * cosine - by_cosine * sine
            by_points = by_angles.unflatten(-1, (-1, len(self.octaves))) @ self.octaves
            return by_points + cotangent[..., :3] if self.include_points else by_points

        return features, pullback


class Rotated(Fourier):
    """Octaves along the axes of turned frames: F = 6 frequencies * frames.

    Along the axes of one frame, a point and its mirror image have two thirds of their features in common, and
    a space of shapes that are mostly symmetric grows mirror images of the parts of others. The frames are
    uniformly random and always the same.
    """

    axes: Tensor

    def __init__(self, frequencies: PositiveInt, frames: PositiveInt = 2):
        super().__init__(frequencies)
        self.features *= frames
        turns = Rotation.random(frames, rng=0).as_matrix().reshape(-1, 3)
        self.register_buffer("axes", torch.tensor(turns, dtype=torch.float32), persistent=False)

    def forward(self, points: Tensor) -> Tensor:
        return super().forward(points @ self.axes.T)

    def with_pullback(self, points: Tensor) -> tuple[Tensor, Pullback]:
        features, pullback = super().with_pullback(points)
        return features, lambda cotangent: pullback(cotangent) @ self.axes


class Gaussian(Encoding):
    """sin(2 pi B x) and cos(2 pi B x) with rows of B drawn once from N(0, sigma^2): F = 2 rows.

    sigma is in cycles per unit of the normalised frame. B is a buffer: it is saved with the weights.

    Source: Tancik et al. 2020, section 5.
    """

    directions: Tensor

    def __init__(self, rows: PositiveInt, sigma: PositiveFloat):
        super().__init__()
        self.features = 2 * rows
        self.register_buffer("directions", torch.randn(rows, 3) * sigma)

    def forward(self, points: Tensor) -> Tensor:
        angles = 2 * math.pi * points @ self.directions.T
        return torch.cat([torch.sin(angles), torch.cos(angles)], dim=-1)


class Hash(Encoding):
    """Learned features on grids of growing resolution, stored in hashed tables: F = levels * width.

    Interpolation is by smoothstep 3t^2 - 2t^3, whose derivative is continuous across cells, so that normals
    can be supervised; a level whose grid fits its table is indexed directly, without collisions.

    Source: Mueller et al. 2022, sections 3 and 3.1 ("smooth interpolation").

    Args:
        levels: number of grids.
        width: features per level.
        log2_table: base-2 logarithm of the rows of a level's table.
        coarsest: cells along an axis of the first grid, over [-1, 1].
        finest: cells along an axis of the last grid; geometric in between.
        include_points: whether x comes first among the features; tables alone start with no slope.
    """

    cells: Tensor
    starts: Tensor

    def __init__(
        self,
        levels: PositiveInt,
        width: PositiveInt,
        log2_table: Annotated[int, Field(ge=1, le=30)],
        coarsest: PositiveInt,
        finest: PositiveInt,
        include_points: bool = True,
    ):
        super().__init__()
        if finest < coarsest:
            raise ValueError(f"finest: must be at least {coarsest}, as coarsest is, not {finest}")
        growth = (finest / coarsest) ** (1 / max(levels - 1, 1))
        cells = [round(coarsest * growth**level) for level in range(levels)]
        self.rows = [min((n + 1) ** 3, 2**log2_table) for n in cells]
        self.dense = sum((n + 1) ** 3 <= 2**log2_table for n in cells)  # the first levels, as cells grow
        self.include_points, self.width = include_points, width
        self.features = levels * width + 3 * include_points
        self.table = nn.Parameter(torch.empty(sum(self.rows), width).uniform_(-1e-4, 1e-4))
        self.register_buffer("cells", torch.tensor(cells), persistent=False)
        self.register_buffer("starts", torch.tensor([0, *self.rows]).cumsum(0)[:-1], persistent=False)

    def forward(self, points: Tensor) -> Tensor:
        return self._encode(points)[0]

    def with_pullback(self, points: Tensor) -> tuple[Tensor, Pullback]:
        features, corners, (x, y, z), slope = self._encode(points)

        def pullback(cotangent: Tensor) -> Tensor:
            flat = cotangent.flatten(0, -2)
            by_level = flat[:, 3 * self.include_points :].T.unflatten(0, (-1, self.width))
            moved = (corners * by_level.transpose(0, 1)[:, None, None, None]).sum(0)  # [2, 2, 2, K, P]
            along_z = (moved * z).sum(2)
            along_xy = (moved * (x[:, None] * y)[:, :, None]).sum((0, 1))
            parts = (along_z * y).sum(1), (along_z * x[:, None]).sum(0), along_xy
            steps = torch.stack([part[1] - part[0] for part in parts])
            by_point = (steps * slope).sum(1).T
            by_point = by_point + flat[:, :3] if self.include_points else by_point
            return by_point.unflatten(0, cotangent.shape[:-1])

        return features, pullback

    def _encode(self, points: Tensor) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor, Tensor], Tensor]:
        """Features [..., F] and what they are made of, for P points, K levels and C features a level.

        Table entries [C, 2, 2, 2, K, P] of the low and high corners in x, y and z; for each of these axes the
        corners' weights [2, K, P]; slopes [3, K, P] of the high corner's. CPUs like points as the last axis.
        """
        position = (points.flatten(0, -2).T[:, None] + 1) / 2 * self.cells[:, None]
        low = position.detach().floor()
        t = position - low
        smooth = t * t * (3 - 2 * t)
        x, y, z = torch.stack([1 - smooth, smooth], dim=1)
        weights = (x[:, None] * y)[:, :, None] * z
        rows = self._rows_of(low.long())
        # the gradient of an embedding takes seven times as long on a CPU
        corners = self.table.index_select(0, rows.flatten()).T.unflatten(1, rows.shape)
        features = (weights * corners).sum((1, 2, 3))  # [C, K, P]
        features = features.transpose(0, 1).flatten(0, 1).T.unflatten(0, points.shape[:-1])
        features = torch.cat([points, features], dim=-1) if self.include_points else features
        return features, corners, (x, y, z), 3 * t * (1 - t) * self.cells[:, None]

    def _rows_of(self, low: Tensor) -> Tensor:
        """Table rows [2, 2, 2, K, P] of the corners of cells with low corners [3, K, P]."""
        pairs = torch.stack([low, low + 1], dim=1)  # [3, 2, K, P]
        last = self.cells[: self.dense, None]
        x, y, z = torch.minimum(pairs[:, :, : self.dense].clamp(min=0), last)  # jitter may leave the cube
        fitting = ((x[:, None] * (last + 1) + y)[:, :, None] * (last + 1)) + z
        x, y, z = (axis * prime for axis, prime in zip(pairs[:, :, self.dense :], PRIMES, strict=True))
        hashed = ((x[:, None] ^ y)[:, :, None] ^ z) % max(self.rows)
        return torch.cat([fitting, hashed], dim=-2) + self.starts[:, None]
