"""From what was scanned to bounds of signed distances: one observation, whatever the scan was."""

from dataclasses import replace
from typing import Annotated, Any

import igl
import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat
from pydantic.dataclasses import dataclass
from scipy.ndimage import distance_transform_edt, label
from scipy.spatial import cKDTree

from sdfhub.shapes import Observation

GAPS = 3  # median distances between neighbours that a random cloud may leave bare around a point
PLANES = 8  # nearest points whose tangent planes a place is at least from: at an edge, those of both sides
BOUNDS = 2  # raised when the same scan gives other bounds: what was measured with the old ones counts no more
SEALED = 5  # median distances between neighbours that no gap of a random cloud reaches across
NEIGHBOURS = 10  # points that a tangent plane is fitted to
ENOUGH = 8192  # points that noise is measured on: of more, neighbours lie within the noise of each other
QUIETEST, SHARE = 0.3, 0.817  # flattest places, and what they show of the noise (chi of 7 degrees of freedom)
EDGE = 1.2  # half the edge of the cube in which the outside is flooded, normalised frame
RAYS = 4  # rays nearest to a place that must all have passed it

Array = np.ndarray | None
Share = Annotated[float, Field(ge=0, le=1)]


@dataclass(frozen=True)
class Evidence:
    """How an observation is made of a scan. Source of the jitter near surfaces: DeepSDF's published code."""

    rows: Annotated[int, Field(ge=4)] = 8192  # N, bounded points of an observation
    samples: Annotated[int, Field(ge=4)] = 16384  # the same of signed samples: as many as `evaluate` fits
    surface: Share = 0.25  # of them on the surface
    uniform: Share = 0.15  # of them, as far as the surface leaves any, in the cube or where it was seen empty
    variances: Annotated[tuple[PositiveFloat, ...], Field(min_length=1)] = (0.005, 0.0005)  # of near ones
    cells: Annotated[int, Field(ge=8)] = 64  # along an axis of the grid of empty space
    certain: Annotated[float, Field(ge=0, lt=0.5)] = 0.2  # distance of the winding number from 1/2 for a sign
    background: bool = False  # whether a sensor's rays beside those that met something crossed empty space
    quiet: NonNegativeFloat = 0.003  # noise below this is none: a smooth surface's curvature looks like it

    def of_samples(self, points: np.ndarray, sdf: np.ndarray, rng: np.random.Generator) -> Observation:
        """From points [N, 3] and their signed distances [N], on both sides: half of the samples inside."""
        half = self.samples // 2
        sides = (np.flatnonzero(sdf >= 0), self.samples - half), (np.flatnonzero(sdf < 0), half)
        rows = np.concatenate([np.resize(rng.permutation(side), count) for side, count in sides])
        rows = rng.permutation(rows)
        return Observation.of_samples(points[rows], sdf[rows])

    def of_cloud(self, points: np.ndarray, normals: Array, rng: np.random.Generator) -> Observation:
        """From points [M, 3] all over a closed surface, normalised frame, with normals [M, 3] or without.

        A place is at most as far as the nearest point, and at least as far as tangent planes there or what
        the gaps between points leave. Its side: by the winding number with normals, without them by a flood.
        """
        noise, spacing, tree = self._measured(points)
        uniform, near = self._counts()
        deviation = np.sqrt(self.variances)[np.arange(near) % len(self.variances), None]
        at = points[rng.integers(len(points), size=near)] + deviation * rng.standard_normal((near, 3))
        at = np.concatenate([at, rng.uniform(-1, 1, (uniform, 3))])
        distances, nearest = tree.query(at, PLANES)
        distance = distances[:, 0]
        # the nearest of many scattered points lies nearer than the surface
        least = np.sqrt(np.maximum(np.maximum(distance - noise, 0) ** 2 - (GAPS * spacing) ** 2, 0))
        if normals is None:
            outside = is_outside(points, at, max(SEALED * spacing, 3 * noise), self.cells)
            inside = np.zeros_like(outside)
        else:
            apart = np.einsum("ijk,ijk->ij", at[:, None] - points[nearest], normals[nearest])
            least = np.maximum(least, np.abs(apart).min(axis=1) - 2 * noise)
            turns = winding(points, normals, at)
            outside, inside = turns < 0.5 - self.certain, turns > 0.5 + self.certain
        most, unsigned = distance + 3 * noise, ~outside & ~inside
        low = np.where(outside | unsigned, least, -most)
        return self._with_surface(points, (at, low, np.where(inside, -least, most), unsigned), noise, rng)

    def of_view(self, points: np.ndarray, normals: Array, sensor: np.ndarray, rng: Any) -> Observation:
        """From points [M, 3] that a sensor [3] saw, with normals [M, 3] or without.

        Free space is at least as far from surfaces as from space not known to be free, and at most as far as
        from the nearest seen point. Beside seen points, the side of the sensor is outside.
        """
        noise, spacing, tree = self._measured(points)
        uniform, near = self._counts()
        flat = np.arange(len(points))
        if normals is None:
            normals, scatter = tangent_planes(points)  # to be trusted on the flatter half
            flat = np.flatnonzero(scatter <= np.median(scatter))
        away = np.einsum("ij,ij->i", normals, points - sensor) > 0
        normals = np.where(away[:, None], -normals, normals)
        steps = max(2 * spacing, 3 * noise) * np.repeat([1, -1], len(flat))
        beside = np.tile(points[flat], (2, 1)) + steps[:, None] * np.tile(normals[flat], (2, 1))
        own = np.flatnonzero(tree.query(beside)[1] == np.tile(flat, 2))
        own = rng.choice(own, near) if len(own) else own
        beside, steps = beside[own], steps[own]
        slack = np.where(steps > 0, noise, np.abs(steps))  # the part may be thin behind its face
        empty, clear = free_space(points, sensor, self.cells, self.background)
        rows = rng.integers(len(empty), size=uniform) if len(empty) else np.zeros(0, np.int64)
        at = np.concatenate([beside, empty[rows]])
        low = np.concatenate([steps - slack, clear[rows]])
        high = np.concatenate([np.maximum(steps, 0) + noise, tree.query(empty[rows])[0] + spacing])
        bounds = at, np.minimum(low, high), high, np.zeros(len(at), bool)
        return replace(self._with_surface(points, bounds, noise, rng), partial=True)

    def _measured(self, points: np.ndarray) -> tuple[float, float, cKDTree]:
        """Noise of points [M, 3], none where there is hardly any, their spacing, and a tree of them."""
        noise, tree = noise_of(points), cKDTree(points)
        return noise if noise > self.quiet else 0.0, float(np.median(tree.query(points, 2)[0][:, 1])), tree

    def _counts(self) -> tuple[int, int]:
        """How many rows lie anywhere, and near the surface."""
        rest = self.rows - round(self.surface * self.rows)
        uniform = min(round(self.uniform * self.rows), rest)
        return uniform, rest - uniform

    def _with_surface(self, points, bounds: tuple[np.ndarray, ...], noise: float, rng) -> Observation:
        """Places, their bounds and `unsigned`, and for the rest of the rows surface points; shuffled."""
        surface = points[np.resize(rng.permutation(len(points)), self.rows - len(bounds[0]))]
        zero, order = np.zeros(len(surface)), rng.permutation(self.rows)
        pairs = zip(bounds, (surface, zero, zero, zero > 0), strict=True)
        at, low, high, unsigned = (np.concatenate(pair)[order] for pair in pairs)
        points, low, high = (part.astype(np.float32) for part in (at, low, high))
        return Observation(points, low, high, unsigned, float(noise))


def noise_of(points: np.ndarray) -> float:
    """Deviation of points [N, 3] across their surface: how they scatter about planes where it is flat."""
    _, scatter = tangent_planes(points[:: max(1, -(-len(points) // ENOUGH))])
    unbiased = np.sqrt(NEIGHBOURS / (NEIGHBOURS - 3))  # a plane takes three numbers
    return float(np.quantile(scatter, QUIETEST) * unbiased / SHARE)


def tangent_planes(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit normals [N, 3], of either sign, and the neighbours' root mean square distance to the plane [N]."""
    _, near = cKDTree(points).query(points, min(NEIGHBOURS, len(points)))
    apart = points[near] - points[near].mean(axis=1, keepdims=True)
    values, axes = np.linalg.eigh(apart.transpose(0, 2, 1) @ apart / near.shape[1])
    return axes[:, :, 0], np.sqrt(np.maximum(values[:, 0], 0))


def grid_of(axis: np.ndarray) -> np.ndarray:
    """[n^3, 3] the nodes of a cubic grid with these coordinates [n] along each axis."""
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)


def is_outside(points: np.ndarray, at: np.ndarray, reach: float, cells: int) -> np.ndarray:
    """[Q] whether a flood from afar, in cells^3, comes to places `at` [Q, 3] past a cloud [N, 3].

    It keeps off by `reach`, and by half a cell's diagonal, as it would leak through thinner walls.
    """
    reach = max(reach, 3**0.5 * EDGE / (cells - 1))
    nodes = grid_of(np.linspace(-EDGE, EDGE, cells))
    near = np.isfinite(cKDTree(points).query(nodes, distance_upper_bound=reach)[0]).reshape((cells,) * 3)
    pieces, _ = label(np.pad(~near, 1, constant_values=True))  # afar is free, though the corners may be near
    cell = np.rint((at + EDGE) / (2 * EDGE) * (cells - 1)).astype(np.int64).clip(0, cells - 1) + 1
    return pieces[tuple(cell.T)] == pieces[0, 0, 0]


def winding(points: np.ndarray, normals: np.ndarray, at: np.ndarray) -> np.ndarray:
    """[Q] winding numbers of an oriented cloud [N, 3] about the points `at` [Q, 3]: near 1 inside, 0 outside.

    Source: Barill et al. 2018; a point stands for a disc up to its neighbours, shared with them.
    """
    distance = cKDTree(points).query(points, min(NEIGHBOURS + 1, len(points)))[0]
    areas = np.pi * distance[:, -1] ** 2 / (distance.shape[1] - 1)
    return igl.fast_winding_number(*map(np.ascontiguousarray, (points, normals, areas, at)))


def free_space(points: np.ndarray, sensor: np.ndarray, cells: int, background: bool) -> tuple[Any, Any]:
    """Centres [K, 3] of cells that a sensor [3] whose rays ended at points [N, 3] saw to be empty.

    The rays nearest to such a cell ended a cell behind it; with `background` also where no ray ended near.
    Its distance to the nearest cell that is not free bounds that to any surface from below, [K] >= 0.
    """
    size = 2 / cells
    centres = grid_of(-1 + size * (np.arange(cells) + 0.5))
    rays, reached = _directions(points - sensor)
    towards, depth = _directions(centres - sensor)
    tree = cKDTree(rays)
    wide = 2 * np.median(tree.query(rays, 2)[0][:, 1])
    # a cell is as wide as its own rays: no other may end in it
    apart, near = tree.query(towards, RAYS, distance_upper_bound=float(max(wide, 0.02)))
    is_free = np.zeros(len(centres), bool)
    rows = np.flatnonzero(np.isfinite(apart).all(axis=1))
    is_free[rows] = depth[rows] < reached[near[rows]].min(axis=1) - size
    if background:
        is_free |= np.isinf(apart).all(axis=1)
    padded = np.pad(is_free.reshape((cells,) * 3), 1)  # nothing is known beyond the cube
    clear = distance_transform_edt(padded)[1:-1, 1:-1, 1:-1].ravel()[is_free]
    return centres[is_free], np.maximum(clear - np.sqrt(3), 0) * size


def _directions(vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    length = np.linalg.norm(vectors, axis=1)
    return vectors / np.maximum(length, 1e-12)[:, None], length
