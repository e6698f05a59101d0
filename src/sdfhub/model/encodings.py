"""Positional encodings gamma(x): points [..., 3] in the unit ball become features [..., F].

Every rival is a module with an attribute `features` (F) and a `forward` that can be differentiated twice,
because the normal loss differentiates the field's spatial gradient by the weights. Where the Jacobian has a
short formula, `with_pullback` states it; the others inherit one that asks autograd.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable

import torch
from torch import Tensor, nn

PRIMES = (1, 2_654_435_761, 805_459_861)
"""Factors of the spatial hash. Source: Mueller et al. 2022, section 3."""


class Encoding(nn.Module, ABC):
    """A map from points to features.

    Attributes:
        features: F, the number of features of a point.
    """

    features: int

    @abstractmethod
    def forward(self, points: Tensor) -> Tensor:
        """Encodes points [..., 3], normalised frame, as [..., F]."""

    def with_pullback(self, points: Tensor) -> tuple[Tensor, "Pullback"]:
        """Features [..., F] and the map of a cotangent v [..., F] to J(x)^T v [..., 3], differentiable."""
        with torch.enable_grad():
            points = points.detach().requires_grad_()
            features = self(points)

        def pullback(cotangent: Tensor) -> Tensor:
            return torch.autograd.grad(features, points, cotangent, create_graph=True)[0]

        return features, pullback


Pullback = Callable[[Tensor], Tensor]
"""What a cotangent of features is in space: [..., F] -> [..., 3]."""


class Identity(Encoding):
    """The coordinates themselves: F = 3."""

    features = 3

    def forward(self, points: Tensor) -> Tensor:
        return points

    def with_pullback(self, points: Tensor) -> tuple[Tensor, Pullback]:
        return points, lambda cotangent: cotangent


class Fourier(Encoding):
    """sin(2^k pi x) and cos(2^k pi x) for k = 0 ... frequencies - 1, per axis: F = 6 frequencies (+ 3).

    Source: Mildenhall et al. 2020, equation 4; the paper's "FFT".

    Args:
        frequencies: number of octaves, >= 1.
        include_points: whether the coordinates themselves come first among the features.
    """

    def __init__(self, frequencies: int, include_points: bool = False):
        super().__init__()
        if frequencies < 1:
            raise ValueError(f"frequencies must be at least 1, got {frequencies}")
        self.include_points = include_points
        self.features = 6 * frequencies + 3 * include_points
        self.register_buffer("octaves", math.pi * 2.0 ** torch.arange(frequencies), persistent=False)

    def forward(self, points: Tensor) -> Tensor:
        angles = (points[..., None] * self.octaves).flatten(-2)
        waves = [torch.sin(angles), torch.cos(angles)]
        return torch.cat([points, *waves] if self.include_points else waves, dim=-1)

    def with_pullback(self, points: Tensor) -> tuple[Tensor, Pullback]:
        features = self(points)
        sine, cosine = features[..., 3 * self.include_points :].chunk(2, dim=-1)

        def pullback(cotangent: Tensor) -> Tensor:
            by_sine, by_cosine = cotangent[..., 3 * self.include_points :].chunk(2, dim=-1)
            by_angle = by_sine * cosine - by_cosine * sine
            by_point = by_angle.unflatten(-1, (3, -1)) @ self.octaves
            return by_point + cotangent[..., :3] if self.include_points else by_point

        return features, pullback


class Gaussian(Encoding):
    """sin(2 pi B x) and cos(2 pi B x) with rows of B drawn once from N(0, sigma^2): F = 2 rows.

    Source: Tancik et al. 2020, section 5. B is a buffer: it is saved with the weights.

    Args:
        rows: number of random directions, >= 1.
        sigma: standard deviation of their entries, in cycles per unit of the normalised frame, > 0.
    """

    def __init__(self, rows: int, sigma: float):
        super().__init__()
        if rows < 1 or sigma <= 0:
            raise ValueError(f"rows must be at least 1 and sigma positive, got {rows} and {sigma}")
        self.features = 2 * rows
        self.register_buffer("directions", torch.randn(rows, 3) * sigma)

    def forward(self, points: Tensor) -> Tensor:
        angles = 2 * math.pi * points @ self.directions.T
        return torch.cat([torch.sin(angles), torch.cos(angles)], dim=-1)

    def with_pullback(self, points: Tensor) -> tuple[Tensor, Pullback]:
        features = self(points)
        sine, cosine = features.chunk(2, dim=-1)

        def pullback(cotangent: Tensor) -> Tensor:
            by_sine, by_cosine = cotangent.chunk(2, dim=-1)
            return 2 * math.pi * (by_sine * cosine - by_cosine * sine) @ self.directions

        return features, pullback


class Hash(Encoding):
    """Learned features on grids of growing resolution, stored in hashed tables: F = levels * width.

    Interpolation is by smoothstep 3t^2 - 2t^3, whose derivative is continuous across cells, so that normals
    can be supervised; a level whose grid fits its table is indexed directly, without collisions.

    Source: Mueller et al. 2022, sections 3 and 3.1 ("smooth interpolation").

    Args:
        levels: number of grids, >= 1.
        width: features per level.
        log2_table: base-2 logarithm of the rows of a level's table.
        coarsest: cells along an axis of the first grid, over [-1, 1].
        finest: cells along an axis of the last grid; geometric in between.
        include_points: whether the coordinates come first among the features (a table alone gives no slope
            between shapes).
    """

    def __init__(
        self,
        levels: int,
        width: int,
        log2_table: int,
        coarsest: int,
        finest: int,
        include_points: bool = True,
    ):
        super().__init__()
        if min(levels, width, coarsest) < 1 or finest < coarsest or not 1 <= log2_table <= 30:
            raise ValueError(
                "hash: needs levels, width, coarsest >= 1, finest >= coarsest, 1 <= log2_table <= 30; "
                f"got {levels}, {width}, {coarsest}, {finest}, {log2_table}"
            )
        growth = (finest / coarsest) ** (1 / max(levels - 1, 1))
        self.cells = [round(coarsest * growth**level) for level in range(levels)]
        self.rows = [min((cells + 1) ** 3, 2**log2_table) for cells in self.cells]
        self.include_points = include_points
        self.features = levels * width + 3 * include_points
        self.tables = nn.ParameterList(nn.Parameter(torch.empty(rows, width)) for rows in self.rows)
        for table in self.tables:
            nn.init.uniform_(table, -1e-4, 1e-4)
        corners = torch.cartesian_prod(*[torch.arange(2)] * 3)
        self.register_buffer("corners", corners, persistent=False)

    def forward(self, points: Tensor) -> Tensor:
        unit = (points + 1) / 2
        features = [points] if self.include_points else []
        for cells, table in zip(self.cells, self.tables, strict=True):
            features.append(self._interpolate(unit * cells, cells, table))
        return torch.cat(features, dim=-1)

    def _interpolate(self, position: Tensor, cells: int, table: Tensor) -> Tensor:
        """Smoothly blends the features of the eight corners around `position` [..., 3], in cells."""
        low = position.detach().floor()
        fraction = position - low
        smooth = fraction * fraction * (3 - 2 * fraction)
        corner = self.corners.to(position.dtype)
        # weights [..., 8]: product over axes of t (corner bit 1) or 1 - t (corner bit 0)
        weights = (corner * smooth[..., None, :] + (1 - corner) * (1 - smooth[..., None, :])).prod(-1)
        index = self._rows_of(low.long()[..., None, :] + self.corners, cells, len(table))
        return (weights[..., None] * table[index]).sum(-2)

    @staticmethod
    def _rows_of(vertex: Tensor, cells: int, rows: int) -> Tensor:
        """Table rows of grid vertices [..., 3]: dense where the grid fits, else the spatial hash."""
        if (cells + 1) ** 3 <= rows:
            x, y, z = vertex.clamp(0, cells).unbind(-1)
            return (x * (cells + 1) + y) * (cells + 1) + z
        x, y, z = (vertex[..., axis] * PRIMES[axis] for axis in range(3))
        return (x ^ y ^ z) % rows
