"""What a point cloud says about its surface: spacing, noise, tangent planes, which side is outside."""

import igl
import numpy as np
from scipy.ndimage import label
from scipy.spatial import cKDTree

NEIGHBOURS = 10
"""Points that a tangent plane is fitted to."""

ENOUGH = 8192
"""Points that noise is measured on: of more, neighbours would lie within the noise of each other."""

QUIETEST, SHARE = 0.3, 0.817
"""Places from the flattest up that tell the noise, and what they show of it (chi of 7 degrees of freedom)."""

EDGE = 1.2
"""Half the edge of the cube in which the outside is flooded, normalised frame."""


def spacing_of(points: np.ndarray) -> float:
    """Median distance from a point of [N, 3] to its nearest neighbour, in its units."""
    return float(np.median(cKDTree(points).query(points, 2)[0][:, 1]))


def noise_of(points: np.ndarray) -> float:
    """Standard deviation of points [N, 3] across their surface, in their units.

    How far neighbours scatter about their plane, at the flattest places: at edges and thin parts no plane
    fits. A curved surface looks a little noisy.
    """
    some = points[:: max(1, -(-len(points) // ENOUGH))]
    _, scatter = tangent_planes(some)
    unbiased = np.sqrt(NEIGHBOURS / (NEIGHBOURS - 3))  # a plane takes three numbers
    return float(np.quantile(scatter, QUIETEST) * unbiased / SHARE)


def tangent_planes(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit normals [N, 3], of either sign, and the neighbours' root mean square distance to the plane [N]."""
    _, near = cKDTree(points).query(points, min(NEIGHBOURS, len(points)))
    apart = points[near] - points[near].mean(axis=1, keepdims=True)
    values, axes = np.linalg.eigh(apart.transpose(0, 2, 1) @ apart / near.shape[1])
    return axes[:, :, 0], np.sqrt(np.maximum(values[:, 0], 0))


def is_outside(points: np.ndarray, at: np.ndarray, reach: float, cells: int) -> np.ndarray:
    """[Q] whether places `at` [Q, 3] can be reached from afar without coming near a cloud [N, 3].

    A flood fill of the cube [-1.2, 1.2]^3. Where the cloud has gaps wider than twice the reach, it comes in.

    Args:
        points, at: normalised frame.
        reach: how near is near; more than the gaps between points, less than the parts between them.
        cells: of the cube along an axis.
    """
    axis = np.linspace(-EDGE, EDGE, cells)
    nodes = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    tree = cKDTree(points)
    near = np.isfinite(tree.query(nodes, distance_upper_bound=reach)[0]).reshape((cells,) * 3)
    pieces, _ = label(np.pad(~near, 1, constant_values=True))  # afar is free, though the corners may be near
    cell = np.rint((at + EDGE) / (2 * EDGE) * (cells - 1)).astype(np.int64).clip(0, cells - 1) + 1
    return pieces[tuple(cell.T)] == pieces[0, 0, 0]


def cell_radius(cells: int) -> float:
    """Half the diagonal of a cell of the flood's cube, normalised frame: the least reach that stops it."""
    return 3**0.5 * EDGE / (cells - 1)


def areas_of(points: np.ndarray) -> np.ndarray:
    """[N] the area that each point stands for: a disc up to its neighbours, shared with them."""
    distance = cKDTree(points).query(points, min(NEIGHBOURS + 1, len(points)))[0]
    return np.pi * distance[:, -1] ** 2 / (distance.shape[1] - 1)


def winding(points: np.ndarray, normals: np.ndarray, areas: np.ndarray, at: np.ndarray) -> np.ndarray:
    """[Q] winding numbers of an oriented cloud about the points `at` [Q, 3]: near 1 inside, 0 outside.

    Source: Barill et al. 2018.
    """
    tree = np.ascontiguousarray(points), np.ascontiguousarray(normals), np.ascontiguousarray(areas)
    return igl.fast_winding_number(*tree, np.ascontiguousarray(at, np.float64))
