"""Winding numbers of closed meshes, by counting what a vertical ray crosses."""

import numpy as np

TOGETHER = 1024
"""Faces compared with all points at a time, which bounds the memory: some 165 bytes a pair that may meet."""


def closed_winding_numbers(vertices: np.ndarray, faces: np.ndarray, points: np.ndarray) -> np.ndarray:
    """How often a closed mesh winds around each point: 1 inside, 0 outside, more where pieces overlap.

    The ray from a point upwards crosses faces that look up (+1) and faces that look down (-1); their sum is
    the winding number, a whole number, since every edge is used as often in one direction as in the other.
    Points are kept in a grid of columns, so that a face meets only those below or above it.

    Args:
        vertices: [V, 3], any frame.
        faces: [F, 3] rows of `vertices`, of a closed mesh (`is_closed`); outward ones give positive numbers.
        points: [N, 3], N > 0, in general position: above no edge.

    Returns:
        [N] int64.
    """
    groups = np.array_split(faces, max(1, -(-len(faces) // TOGETHER)))  # long faces overlap many points
    return sum(_crossings(vertices, group, points) for group in groups)


def _crossings(vertices: np.ndarray, faces: np.ndarray, points: np.ndarray) -> np.ndarray:
    """[N] of upward rays: faces crossed that look up, less those that look down."""
    face, point = _overlaps(vertices[:, :2], faces, points[:, :2])
    corners, at = faces[face], points[point]
    sides = [_side(vertices, corners[:, i - 2], corners[:, i - 1], at) for i in range(3)]
    inside = ((sides[0] >= 0) == (sides[1] >= 0)) & ((sides[1] >= 0) == (sides[2] >= 0))
    corners, point, sides = corners[inside], point[inside], [side[inside] for side in sides]
    area = sum(sides)  # barycentric coordinates are the sides' shares of it
    height = sum(side * vertices[corners[:, i], 2] for i, side in enumerate(sides))
    above = (height - area * points[point, 2]) * np.sign(area) > 0
    counts = [np.bincount(point[above & (sign * area > 0)], minlength=len(points)) for sign in (1, -1)]
    return counts[0] - counts[1]


def _side(vertices: np.ndarray, start: np.ndarray, end: np.ndarray, at: np.ndarray) -> np.ndarray:
    """[P] twice the area of (start, end, at) seen from above; exactly opposite for the reversed edge."""
    low, high = np.minimum(start, end), np.maximum(start, end)
    (ax, ay), (bx, by) = vertices[low, :2].T, vertices[high, :2].T
    area = (bx - ax) * (at[:, 1] - ay) - (by - ay) * (at[:, 0] - ax)
    return np.where(start == low, area, -area)


def _overlaps(places: np.ndarray, faces: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows [P] of faces and of points that may lie above each other: all pairs that do are among them."""
    cells = int(np.ceil(2 * np.sqrt(len(points))))
    low, size = points.min(axis=0), np.maximum(np.ptp(points, axis=0), 1e-300) * (1 + 1e-9)
    column = ((points - low) * (cells / size)).astype(np.int64) @ (cells, 1)
    order = np.argsort(column, kind="stable")
    first = np.searchsorted(column[order], np.arange(cells**2 + 1))  # point of each cell
    x, y = np.floor((places - low) * (cells / size)).T[:, faces]  # [F, 3] cells of the corners
    rows = [np.clip(end, 0, cells - 1).astype(np.int64) for end in (x.min(1), x.max(1))]
    ends = [np.clip(end, 0, cells - 1).astype(np.int64) for end in (y.min(1), y.max(1))]
    face, step = _spread(rows[1] - rows[0] + 1)
    row = (rows[0][face] + step) * cells  # cells of a row follow each other, and so do their points
    start, stop = first[row + ends[0][face]], first[row + ends[1][face] + 1]
    strip, step = _spread(stop - start)
    return face[strip], order[start[strip] + step]


def _spread(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Each index as often as its count says, and beside it 0, 1, ... up to the count."""
    index = np.repeat(np.arange(len(counts)), counts)
    return index, np.arange(len(index)) - np.repeat(np.cumsum(counts) - counts, counts)
