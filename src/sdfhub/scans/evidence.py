"""From what was scanned to bounds of signed distances: one observation, whatever the scan was."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from sdfhub.scans.cloud import (
    areas_of,
    cell_radius,
    is_outside,
    noise_of,
    spacing_of,
    tangent_planes,
    winding,
)
from sdfhub.scans.free_space import free_space
from sdfhub.shapes import Observation

Bounds = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Points [N, 3], least and largest distance there [N], and whether its sign is unknown [N]."""

GAPS = 3
"""Median distances between neighbours that a random cloud may leave bare around a point."""

PLANES = 8
"""Nearest points whose tangent planes a place is at least from: at an edge, those of both sides."""

BOUNDS = 2
"""Raised when the same scan gives other bounds: what was measured with the old ones counts no more."""

SEALED = 5
"""Median distances between neighbours that no gap of a random cloud reaches across."""


@dataclass(frozen=True)
class Evidence:
    """How an observation is made of a scan.

    Source: the jitter of points near the surface is DeepSDF's (its published code).

    Args:
        rows: N, bounded points of an observation, >= 4.
        samples: the same of signed samples, >= 4: as many as `evaluate` fits.
        surface: share of them on the surface, in [0, 1].
        uniform: share of them anywhere in the cube, or in the space a sensor saw to be empty, in [0, 1].
        variances: squared standard deviations of the jitter of the others, normalised units squared.
        cells: along an axis of the grid of empty space, >= 8.
        certain: a sign counts where the winding number is this far from 1/2, in [0, 0.5).
        background: whether a sensor's rays beside those that met something crossed empty space.
        quiet: noise below this is none, normalised frame: a smooth surface's curvature looks like it.
    """

    rows: int = 8192
    samples: int = 16384
    surface: float = 0.25
    uniform: float = 0.15
    variances: tuple[float, ...] = (0.005, 0.0005)
    cells: int = 64
    certain: float = 0.2
    background: bool = False
    quiet: float = 0.003

    def __post_init__(self):
        object.__setattr__(self, "variances", tuple(self.variances))  # YAML gives a list
        if min(self.rows, self.samples) < 4 or self.cells < 8 or not 0 <= self.certain < 0.5:
            raise ValueError("rows and samples must be at least 4, cells at least 8, certain in [0, 0.5)")
        if min(self.surface, self.uniform) < 0 or self.surface + self.uniform > 1:
            raise ValueError("surface and uniform must be shares that leave room for each other")
        if not self.variances or min(self.variances) <= 0 or self.quiet < 0:
            raise ValueError("variances must be positive numbers, quiet not negative")

    def of_samples(self, points: np.ndarray, sdf: np.ndarray, rng: np.random.Generator) -> Observation:
        """From points [N, 3] and their signed distances [N], on both sides: half of the samples inside."""
        half = self.samples // 2
        sides = (np.flatnonzero(sdf >= 0), self.samples - half), (np.flatnonzero(sdf < 0), half)
        rows = np.concatenate([np.resize(rng.permutation(side), count) for side, count in sides])
        rows = rng.permutation(rows)
        return Observation.of_samples(points[rows], sdf[rows])

    def of_cloud(
        self, points: np.ndarray, normals: np.ndarray | None, rng: np.random.Generator
    ) -> Observation:
        """From points [M, 3] all over a closed surface, normalised frame, with normals [M, 3] or without.

        The distance of a place is at most that to the nearest point, and at least that to tangent planes
        there or what the gaps between points leave. With normals the winding number tells its sign; without
        them it is known only where one comes from outside without meeting the cloud.
        """
        noise = self._noise_in(points)
        tree, spacing = cKDTree(points), spacing_of(points)
        at = np.concatenate([self._near(points, rng), rng.uniform(-1, 1, (self._uniform(), 3))])
        distances, nearest = tree.query(at, PLANES)
        distance = distances[:, 0]
        # the nearest of many scattered points lies nearer than the surface
        least = np.sqrt(np.maximum(np.maximum(distance - noise, 0) ** 2 - (GAPS * spacing) ** 2, 0))
        if normals is not None:
            apart = np.einsum("ijk,ijk->ij", at[:, None] - points[nearest], normals[nearest])
            least = np.maximum(least, np.abs(apart).min(axis=1) - 2 * noise)
        most = distance + 3 * noise
        # a wall thinner than the flood's own cells would let it through
        reach = max(SEALED * spacing, 3 * noise, cell_radius(self.cells))
        outside, inside = self._sides(points, normals, at, reach)
        low = np.where(outside, least, -most)
        high = np.where(inside, -least, most)
        unsigned = ~outside & ~inside
        low[unsigned] = least[unsigned]
        return self._with_surface(points, (at, low, high, unsigned), noise, rng)

    def _sides(self, points, normals, at: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
        """[Q] whether places are surely outside, and surely inside."""
        if normals is None:
            outside = is_outside(points, at, reach, self.cells)
            return outside, np.zeros_like(outside)
        turns = winding(points, normals, areas_of(points), at)
        return turns < 0.5 - self.certain, turns > 0.5 + self.certain

    def of_view(
        self,
        points: np.ndarray,
        normals: np.ndarray | None,
        sensor: np.ndarray,
        rng: np.random.Generator,
    ) -> Observation:
        """From points [M, 3] that one sensor at `sensor` [3] saw, with normals [M, 3] or without.

        Free space is at least as far from any surface as from space not known to be free, and nothing is
        further from the surface than from the nearest seen point. Beside the seen points, the side of the
        sensor is outside.
        """
        noise = self._noise_in(points)
        tree, spacing = cKDTree(points), spacing_of(points)
        beside, steps = self._beside(points, normals, sensor, max(2 * spacing, 3 * noise), tree, rng)
        slack = np.where(steps > 0, noise, np.abs(steps))  # the part may be thin behind its face
        empty, clear = free_space(points, sensor, self.cells, self.background)
        some = rng.integers(len(empty), size=self._uniform()) if len(empty) else np.zeros(0, np.int64)
        at = np.concatenate([beside, empty[some]])
        low = np.concatenate([steps - slack, clear[some]])
        high = np.concatenate([np.maximum(steps, 0) + noise, tree.query(empty[some])[0] + spacing])
        none = np.zeros(len(at), bool)
        whole = self._with_surface(points, (at, np.minimum(low, high), high, none), noise, rng)
        return replace(whole, partial=True)

    def _beside(self, points, normals, sensor, step: float, tree, rng) -> tuple[np.ndarray, np.ndarray]:
        """Places [Q, 3] a step before and behind seen points, and the signed steps [Q].

        Where normals are not given, only the flatter half of the surface has such that can be trusted.
        """
        flat = np.arange(len(points))
        if normals is None:
            normals, scatter = tangent_planes(points)
            flat = np.flatnonzero(scatter <= np.median(scatter))
        away = np.einsum("ij,ij->i", normals, points - sensor) > 0
        normals = np.where(away[:, None], -normals, normals)
        steps = np.repeat([step, -step], len(flat))
        beside = np.tile(points[flat], (2, 1)) + steps[:, None] * np.tile(normals[flat], (2, 1))
        own = np.flatnonzero(tree.query(beside)[1] == np.tile(flat, 2))
        count = self.rows - round(self.surface * self.rows) - self._uniform()
        own = rng.choice(own, count) if len(own) else own
        return beside[own], steps[own]

    def _noise_in(self, points: np.ndarray) -> float:
        """The noise of points [M, 3], normalised frame, or 0 where there is hardly any."""
        noise = noise_of(points)
        return noise if noise > self.quiet else 0.0

    def _uniform(self) -> int:
        return min(round(self.uniform * self.rows), self.rows - round(self.surface * self.rows))

    def _near(self, points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        count = self.rows - round(self.surface * self.rows) - self._uniform()
        deviation = np.sqrt(self.variances)[np.arange(count) % len(self.variances), None]
        return points[rng.integers(len(points), size=count)] + deviation * rng.standard_normal((count, 3))

    def _with_surface(
        self, points: np.ndarray, bounds: Bounds, noise: float, rng: np.random.Generator
    ) -> Observation:
        """The bounded places, and for the rest of the rows surface points, whose distance is 0; shuffled."""
        surface = points[np.resize(rng.permutation(len(points)), self.rows - len(bounds[0]))]
        zero = np.zeros(len(surface))
        order = rng.permutation(self.rows)
        pairs = zip(bounds, (surface, zero, zero, zero > 0), strict=True)
        points, low, high, unsigned = (np.concatenate(pair)[order] for pair in pairs)
        return Observation(*(part.astype(np.float32) for part in (points, low, high)), unsigned, float(noise))
