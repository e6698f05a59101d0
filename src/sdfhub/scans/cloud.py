"""What points say about their surface: spacing, noise, tangent planes, which side is outside, empty space."""

import igl
import numpy as np
from scipy.ndimage import distance_transform_edt, label
from scipy.spatial import cKDTree

NEIGHBOURS = 10  # points that a tangent plane is fitted to
ENOUGH = 8192  # points that noise is measured on: of more, neighbours lie within the noise of each other
QUIETEST, SHARE = 0.3, 0.817  # flattest places, and what they show of the noise (chi of 7 degrees of freedom)
EDGE = 1.2  # half the edge of the cube in which the outside is flooded, normalised frame
RAYS = 4  # rays nearest to a place that must all have passed it


def spacing_of(points: np.ndarray) -> float:
    """Median distance from a point of [N, 3] to its nearest neighbour, in its units."""
    return float(np.median(cKDTree(points).query(points, 2)[0][:, 1]))


def noise_of(points: np.ndarray) -> float:
    """Standard deviation of points [N, 3] across their surface, in their units.

    How far neighbours scatter about their plane, at the flattest places. Curves look a little noisy.
    """
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
    """[Q] whether places `at` [Q, 3] can be reached from afar without coming near a cloud [N, 3].

    A flood fill of the cube [-1.2, 1.2]^3 in cells^3. Near is nearer than `reach`, or than half a cell's
    diagonal, as thinner walls would let it through.
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


def free_space(
    points: np.ndarray, sensor: np.ndarray, cells: int, background: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Cells of [-1, 1]^3 that a sensor [3] whose rays ended at points [N, 3] saw to be empty.

    A cell is free if the rays nearest to it, no further apart than rays are from each other, ended a cell
    behind it; with `background` also where no ray ended near. Its distance to the nearest cell that is not
    free bounds that to any surface, seen or unseen: centres [K, 3], and lower bounds [K] >= 0 there.
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
