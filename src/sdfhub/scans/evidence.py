"""From what was scanned to bounds of signed distances: one observation, whatever the scan was."""

from dataclasses import replace
from typing import Annotated

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat
from pydantic.dataclasses import dataclass
from scipy.spatial import cKDTree

from sdfhub.scans import cloud
from sdfhub.shapes import Observation

GAPS = 3  # median distances between neighbours that a random cloud may leave bare around a point
PLANES = 8  # nearest points whose tangent planes a place is at least from: at an edge, those of both sides
BOUNDS = 2  # raised when the same scan gives other bounds: what was measured with the old ones counts no more
SEALED = 5  # median distances between neighbours that no gap of a random cloud reaches across

Share = Annotated[float, Field(ge=0, le=1)]


@dataclass(frozen=True)
class Evidence:
    """How an observation is made of a scan.

    Source: the jitter of points near the surface is DeepSDF's (its published code).
    """

    rows: Annotated[int, Field(ge=4)] = 8192  # N, bounded points of an observation
    samples: Annotated[int, Field(ge=4)] = 16384  # the same of signed samples: as many as `evaluate` fits
    surface: Share = 0.25  # of them on the surface
    uniform: Share = 0.15  # of them anywhere in the cube, or in the space a sensor saw to be empty
    # squared standard deviations of the jitter of the others, normalised units squared
    variances: Annotated[tuple[PositiveFloat, ...], Field(min_length=1)] = (0.005, 0.0005)
    cells: Annotated[int, Field(ge=8)] = 64  # along an axis of the grid of empty space
    certain: Annotated[float, Field(ge=0, lt=0.5)] = 0.2  # distance of the winding number from 1/2 for a sign
    background: bool = False  # whether a sensor's rays beside those that met something crossed empty space
    quiet: NonNegativeFloat = 0.003  # noise below this is none: a smooth surface's curvature looks like it

    def __post_init__(self):
        if self.surface + self.uniform > 1:
            raise ValueError("surface and uniform must be shares that leave room for each other")

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

        A place is at most as far as the nearest point, and at least as far as tangent planes there or what
        the gaps between points leave. With normals the winding number tells its side; without them it is
        known only where one comes from outside without meeting the cloud.
        """
        noise, spacing = self._noise_and_spacing(points)
        _, uniform, near = self._counts()
        deviation = np.sqrt(self.variances)[np.arange(near) % len(self.variances), None]
        at = points[rng.integers(len(points), size=near)] + deviation * rng.standard_normal((near, 3))
        at = np.concatenate([at, rng.uniform(-1, 1, (uniform, 3))])
        distances, nearest = cKDTree(points).query(at, PLANES)
        distance = distances[:, 0]
        # the nearest of many scattered points lies nearer than the surface
        least = np.sqrt(np.maximum(np.maximum(distance - noise, 0) ** 2 - (GAPS * spacing) ** 2, 0))
        if normals is None:
            outside = cloud.is_outside(points, at, max(SEALED * spacing, 3 * noise), self.cells)
            inside = np.zeros_like(outside)
        else:
            apart = np.einsum("ijk,ijk->ij", at[:, None] - points[nearest], normals[nearest])
            least = np.maximum(least, np.abs(apart).min(axis=1) - 2 * noise)
            turns = cloud.winding(points, normals, at)
            outside, inside = turns < 0.5 - self.certain, turns > 0.5 + self.certain
        most, unsigned = distance + 3 * noise, ~outside & ~inside
        low = np.where(outside | unsigned, least, -most)
        return self._with_surface(points, (at, low, np.where(inside, -least, most), unsigned), noise, rng)

    def of_view(
        self, points: np.ndarray, normals: np.ndarray | None, sensor: np.ndarray, rng: np.random.Generator
    ) -> Observation:
        """From points [M, 3] that one sensor at `sensor` [3] saw, with normals [M, 3] or without.

        Free space is at least as far from any surface as from space not known to be free, and at most as far
        as from the nearest seen point. Beside the seen points, the side of the sensor is outside.
        """
        (noise, spacing), tree = self._noise_and_spacing(points), cKDTree(points)
        beside, steps = self._beside(points, normals, sensor, max(2 * spacing, 3 * noise), tree, rng)
        slack = np.where(steps > 0, noise, np.abs(steps))  # the part may be thin behind its face
        empty, clear = cloud.free_space(points, sensor, self.cells, self.background)
        _, uniform, _ = self._counts()
        rows = rng.integers(len(empty), size=uniform) if len(empty) else np.zeros(0, np.int64)
        at = np.concatenate([beside, empty[rows]])
        low = np.concatenate([steps - slack, clear[rows]])
        high = np.concatenate([np.maximum(steps, 0) + noise, tree.query(empty[rows])[0] + spacing])
        bounds = at, np.minimum(low, high), high, np.zeros(len(at), bool)
        return replace(self._with_surface(points, bounds, noise, rng), partial=True)

    def _beside(self, points, normals, sensor, step: float, tree, rng) -> tuple[np.ndarray, np.ndarray]:
        """Places [Q, 3] a step before and behind seen points, and the signed steps [Q].

        Without given normals, only the flatter half of the surface has such that can be trusted.
        """
        flat = np.arange(len(points))
        if normals is None:
            normals, scatter = cloud.tangent_planes(points)
            flat = np.flatnonzero(scatter <= np.median(scatter))
        away = np.einsum("ij,ij->i", normals, points - sensor) > 0
        normals = np.where(away[:, None], -normals, normals)
        steps = np.repeat([step, -step], len(flat))
        beside = np.tile(points[flat], (2, 1)) + steps[:, None] * np.tile(normals[flat], (2, 1))
        own = np.flatnonzero(tree.query(beside)[1] == np.tile(flat, 2))
        own = rng.choice(own, self._counts()[2]) if len(own) else own
        return beside[own], steps[own]

    def _noise_and_spacing(self, points: np.ndarray) -> tuple[float, float]:
        """Of points [M, 3], normalised frame; no noise where there is hardly any."""
        noise = cloud.noise_of(points)
        return (noise if noise > self.quiet else 0.0), cloud.spacing_of(points)

    def _counts(self) -> tuple[int, int, int]:
        """How many rows lie on the surface, anywhere, and near the surface."""
        surface = round(self.surface * self.rows)
        uniform = min(round(self.uniform * self.rows), self.rows - surface)
        return surface, uniform, self.rows - surface - uniform

    def _with_surface(
        self, points: np.ndarray, bounds: tuple[np.ndarray, ...], noise: float, rng: np.random.Generator
    ) -> Observation:
        """Places, their bounds and `unsigned`, and for the rest of the rows surface points; shuffled."""
        surface = points[np.resize(rng.permutation(len(points)), self.rows - len(bounds[0]))]
        zero, order = np.zeros(len(surface)), rng.permutation(self.rows)
        pairs = zip(bounds, (surface, zero, zero, zero > 0), strict=True)
        at, low, high, unsigned = (np.concatenate(pair)[order] for pair in pairs)
        points, low, high = (part.astype(np.float32) for part in (at, low, high))
        return Observation(points, low, high, unsigned, float(noise))
