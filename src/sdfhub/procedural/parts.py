"""Solids that furniture and aircraft are made of, each a closed manifold.

Lengths are metres, +z is up. Every part is built so that its neighbours overlap it: a union of overlapping
solids is one shell, a union of solids that merely touch is not.
"""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from manifold3d import CrossSection, Manifold, Mesh64, OpType

Point = Sequence[float] | np.ndarray  # x, y, z
Profile = Sequence[tuple[float, float]] | np.ndarray  # (radius, height) of a turned part

_SQUARE = np.array([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)])


def union(parts: Sequence[Manifold]) -> Manifold:
    """The solid covered by any of the parts (exact boolean)."""
    return Manifold.batch_boolean(list(parts), OpType.Add)


def rod(bottom: float, top: float, radius: float, segments: int = 14) -> Manifold:
    """An upright round bar on the axis z."""
    return lathe([(radius, bottom), (radius, top)], segments)


def box(size: Point, centre: Point) -> Manifold:
    """An axis-aligned box with sharp edges."""
    return Manifold.cube(np.asarray(size), True).translate(np.asarray(centre))


def rounded_box(size: Point, centre: Point, radius: float, steps: int = 3) -> Manifold:
    """A box of full extents `size` with rounded edges and corners, `steps` facets a quarter of a circle."""
    half = np.asarray(size, float) / 2
    r = min(radius, 0.98 * half.min())
    theta = np.linspace(0, np.pi / 2, steps + 1)
    octant = [(np.cos(p) * np.cos(t), np.cos(p) * np.sin(t), np.sin(p)) for p in theta for t in theta]
    signs = np.array([(i, j, k) for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)], float)
    points = (signs[:, None] * (half - r + r * np.array(octant))).reshape(-1, 3)
    return Manifold.hull_points(np.ascontiguousarray(points + np.asarray(centre, float)))


def pad(outline: np.ndarray, bottom: float, top: float, radius: float, steps: int = 3) -> Manifold:
    """A convex outline [N, 2] extruded with rounded rims; their radius is below half the outline's width."""
    r = min(radius, 0.49 * (top - bottom))
    centre = outline.mean(0)
    reach = np.linalg.norm(outline - centre, axis=1, keepdims=True)
    layers = []
    for angle in np.linspace(0, np.pi / 2, steps + 1):
        inset = centre + (outline - centre) * (1 - r * (1 - np.cos(angle)) / reach)
        for z in (top - r + r * np.sin(angle), bottom + r - r * np.sin(angle)):
            layers.append(level(inset, z))
    return Manifold.hull_points(np.vstack(layers))


def loft(rings: Sequence | np.ndarray) -> Manifold:
    """The solid with flat ends through star-shaped sections [K, N, 3], all with one sense of rotation."""
    sections = np.asarray(rings, float)
    vertices = np.vstack([sections.reshape(-1, 3), sections[0].mean(0), sections[-1].mean(0)])
    faces = _loft_faces(*sections.shape[:2])
    a, b, c = np.moveaxis((vertices - vertices.mean(0))[faces], 1, 0)
    if np.vdot(np.cross(a, b), c) < 0:  # six times the volume
        faces = np.ascontiguousarray(faces[:, ::-1])
    return Manifold(Mesh64(np.ascontiguousarray(vertices), faces))


@lru_cache(maxsize=256)
def _loft_faces(k: int, n: int) -> np.ndarray:
    """[F, 3] uint64 faces between k rings of n points, and fans around the two centres that follow them."""
    i, j = np.meshgrid(np.arange(k - 1), np.arange(n), indexing="ij")
    a, b = (i * n + j).ravel(), (i * n + (j + 1) % n).ravel()
    ring, following = np.arange(n), (np.arange(n) + 1) % n
    last = (k - 1) * n
    sides = np.column_stack([a, b, b + n]), np.column_stack([a, b + n, a + n])
    low = np.column_stack([following, ring, np.full(n, k * n)])
    high = np.column_stack([last + ring, last + following, np.full(n, k * n + 1)])
    return np.ascontiguousarray(np.vstack([*sides, low, high]).astype(np.uint64))


def sweep(path: Sequence | np.ndarray, section: np.ndarray, up: Point = (0, 0, 1)) -> Manifold:
    """A star-shaped section [N, 2] carried along a path [K, 3]: its first axis is tangent x up, its second
    along `up`, which is not parallel to the path; the path's bends must be wider than the section."""
    path = np.asarray(path, float)
    leaving = _unit(np.diff(path, axis=0))
    tangent = _unit(np.vstack([leaving[:1], leaving[:-1] + leaving[1:], leaving[-1:]]))
    side = _unit(np.cross(tangent, np.asarray(up, float)))
    over = np.cross(side, tangent)
    return loft(path[:, None] + section[:, :1] * side[:, None] + section[:, 1:] * over[:, None])


def tube(path: np.ndarray, radius: float, segments: int = 12, up: Point = (0, 0, 1)) -> Manifold:
    """A round bar along a path."""
    return sweep(path, radius * circle(segments), up)


def bar(start: Point, end: Point, radius: float, end_radius: float | None = None) -> Manifold:
    """A straight round bar, tapered from radius to end_radius."""
    return turned(start, end, [(radius, 0.0), (end_radius or radius, 1.0)], segments=14)


def square_bar(start: Point, end: Point, width: float, end_width: float | None = None) -> Manifold:
    """A straight bar of square section with its sides along x and y, cut level at both ends."""
    ends = (start, width), (end, width if end_width is None else end_width)
    return loft([level(w * _SQUARE, 0) + p for p, w in ends])


def plank(start: Point, end: Point, thickness: float, height: float) -> Manifold:
    """A straight board on edge from start to end, its height along z."""
    return sweep(np.array([start, end], float), _SQUARE * [thickness, height])


def turned(start: Point, end: Point, profile: Profile, radius: float = 1.0, segments: int = 18) -> Manifold:
    """A lathe-turned bar: `profile` holds (share of radius, height), from 0 at start to 1 at end."""
    start = np.asarray(start, float)
    axis = np.asarray(end, float) - start
    direction = _unit(axis)
    helper = np.array([1.0, 0, 0]) if abs(direction[0]) < 0.9 else np.array([0, 1.0, 0])
    x = _unit(np.cross(helper, direction))
    placed = np.column_stack([x, np.cross(direction, x), axis, start])
    return lathe(profile, segments, radius, stretch=False).transform(placed)


def lathe(
    profile: Profile, segments: int = 24, radius: float = 1.0, length: float = 1.0, stretch: bool = True
) -> Manifold:
    """A solid of revolution around z through a profile from bottom to top, radii > 0.

    The profile is in shares of `radius` and `length`. `stretch` lets the polygon's area equal the circle's,
    so that few sides do not shrink it.
    """
    turn = 2 * np.pi / segments
    ring = circle(segments) * (np.sqrt(turn / np.sin(turn)) if stretch else 1.0)
    return loft([level(r * ring, z) for r, z in np.asarray(profile, float) * [radius, length]])


def revolve_shell(profile: np.ndarray, thickness: float, segments: int = 32) -> Manifold:
    """An open shell of revolution around z through a profile [N, 2] of its middle, radii > thickness / 2."""
    profile = np.asarray(profile, float)
    tangent = _unit(np.gradient(profile, axis=0))
    normal = np.column_stack([tangent[:, 1], -tangent[:, 0]])
    ring = np.vstack([profile + normal * thickness / 2, (profile - normal * thickness / 2)[::-1]])
    return Manifold.revolve(CrossSection([ring]), segments)


def ellipsoid(radii: Point, centre: Point, segments: int = 24) -> Manifold:
    """An ellipsoid with its axes along x, y and z."""
    return Manifold.sphere(1.0, segments).scale(np.asarray(radii)).translate(np.asarray(centre))


def circle(segments: int) -> np.ndarray:
    """[segments, 2] points on the unit circle, counter-clockwise."""
    angle = 2 * np.pi * np.arange(segments) / segments
    return np.column_stack([np.cos(angle), np.sin(angle)])


def rounded_rectangle(width: float, depth: float, radius: float, back_width: float | None = None):
    """[N, 2] rectangle around 0 with rounded corners; `back_width` is its width at +y where it tapers."""
    back_width = width if back_width is None else back_width
    corners = [(-width, -depth, 180), (width, -depth, 270), (back_width, depth, 0), (-back_width, depth, 90)]
    points = []
    for x, y, first in corners:
        angle = np.radians(np.linspace(first, first + 90, 6))
        middle = np.array([x / 2 - np.sign(x) * radius, y / 2 - np.sign(y) * radius])
        points.append(middle + radius * np.column_stack([np.cos(angle), np.sin(angle)]))
    return np.vstack(points)


def filleted(corners: Sequence[Point] | np.ndarray, radius: float, steps: int = 4) -> np.ndarray:
    """[K, 3] polyline through `corners` with its bends rounded by about `radius`."""
    points = np.asarray(corners, float)
    path = [points[0]]
    for before, corner, after in zip(points[:-2], points[1:-1], points[2:], strict=True):
        start = corner + radius * _unit(before - corner)
        end = corner + radius * _unit(after - corner)
        t = np.linspace(0, 1, steps + 1)[:, None]
        path.extend((1 - t) ** 2 * start + 2 * t * (1 - t) * corner + t**2 * end)
    return np.array([*path, points[-1]])


def spokes(count: int, first: float = -0.5) -> list[np.ndarray]:
    """`count` unit vectors [3] evenly around z; the first points `first` half turns from +x (default: -y)."""
    turns = 2 * np.pi * np.arange(count) / count + first * np.pi
    return [np.array([np.cos(angle), np.sin(angle), 0]) for angle in turns]


def aprons(ends, height: float, thickness: float, tall: float) -> list[Manifold]:
    """Boards at `height` between the tops of four legs: front left, front right, back left, back right."""
    level = [np.array([*top[:2], height]) for top, _ in ends]
    return [plank(level[a], level[b], thickness, tall) for a, b in ((0, 1), (2, 3), (0, 2), (1, 3))]


def stretchers(ends, share: float, style: str, board: Point, radii: Point | None) -> list[Manifold]:
    """What joins four legs from tops to feet, `ends`, at a share of their height: a "shelf", or bars along
    the sides, for "h" and "box" also across; turned with `radii` at their ends and in their middle, or
    `board`s of a thickness and a height."""
    if style == "none":
        return []
    left, right, rear_left, rear_right = (foot + share * (top - foot) for top, foot in ends)
    if style == "shelf":
        return [box((*(2 * np.abs(left[:2])), 0.026), (0, 0, left[2]))]
    pairs = [(left, rear_left), (right, rear_right)]
    if style == "h":
        pairs.append(((left + rear_left) / 2, (right + rear_right) / 2))
    if style == "box":
        pairs += [(left, right), (rear_left, rear_right)]
    if radii is None:
        return [plank(a, b, *board) for a, b in pairs]
    profile = [(radii[0], 0), (radii[1], 0.5), (radii[0], 1)]
    return [turned(a, b, profile) for a, b in pairs]


def level(outline: np.ndarray, z: float) -> np.ndarray:
    """Points [N, 3] of an outline [N, 2] at height z."""
    return np.column_stack([outline, np.full(len(outline), z)])


def mirrored(part: Manifold) -> list[Manifold]:
    """The part and its mirror image across x = 0."""
    return [part, part.mirror((1.0, 0.0, 0.0))]


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
