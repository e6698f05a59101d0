"""Backrests of chairs: a surface that leans and bows, and what is built along it."""

import numpy as np
from manifold3d import Manifold

from sdfhub.procedural import parts

_RAIL = 0.022  # thickness of rails and posts of light backs


def back(chair) -> list[Manifold]:
    """The parts of the chair's backrest, rooted in its seat."""
    if chair.back in ("solid", "hoop"):
        return _shell(chair) if chair.back == "solid" else _hoop(chair)
    between = dict(slats=_slats, spindles=_spindles, ladder=_ladder, panel=_shell)
    return [*_posts(chair), *between[chair.back](chair)]


def point(chair, side: float, height: float) -> np.ndarray:
    """A point of the back's middle surface, `height` metres above the seat.

    `side` runs from -1 (left post) to 1 (right post); the bow and the lean grow with the height.
    """
    h = height / chair.back_height
    if chair.seat == "round":
        x = 0.8 * chair.seat_width / 2 * side
        y = chair.seat_depth / 2 * np.sqrt(1 - (0.8 * side) ** 2) - 0.03
    else:
        y = chair.seat_depth / 2 - 0.026
        x = (chair.half_width(y) - 0.028) * side
    y += chair.back_lean * max(h, 0) ** 1.3 + chair.back_curve * (1 - side**2) * np.clip(h, 0, 1) ** 0.7
    return np.array([x * (1 + 0.06 * h), y, chair.seat_height + height])


def side_at(chair, height: float) -> float:
    """Where the outermost post stands at a height, as the `side` of `point`."""
    if chair.back != "hoop":
        return 1.0
    return float((1 - (height / chair.back_height) ** 2.6) ** (1 / 2.6))


def _inner_sides(chair) -> np.ndarray:
    """Where slats and rods stand between the posts, as the `side` of `point`."""
    return np.linspace(-1, 1, chair.slats + 2)[1:-1]


def _upright(chair, side: float, heights: np.ndarray, section: np.ndarray) -> Manifold:
    """A bar along the back's surface through some heights."""
    return parts.sweep([point(chair, side, h) for h in heights], section, up=(0, 1, 0))


def _rods(chair, tops) -> list[Manifold]:
    """Thin round bars from the seat to heights, one a place between the posts."""
    section, low = chair.spindle_width / 2 * parts.circle(10), -0.5 * chair.seat_thickness
    rods = zip(_inner_sides(chair), tops, strict=True)
    return [_upright(chair, side, np.linspace(low, top, 7), section) for side, top in rods]


def _rail(chair, height: float, tall: float, thick: float, crest: float = 0.0) -> Manifold:
    """A curved rail from post to post; `crest` raises its middle."""
    path = [point(chair, s, height + crest * (1 - s * s)) for s in np.linspace(-1, 1, 13)]
    return parts.sweep(path, parts.rounded_rectangle(thick, tall, 0.3 * thick))


def _posts(chair) -> list[Manifold]:
    w = max(0.8 * chair.leg_width, 0.026)
    square = chair.legs in ("square", "sled")
    section = parts.rounded_rectangle(w, w, 0.12 * w) if square else 0.5 * w * parts.circle(14)
    heights = np.linspace(-0.5 * chair.seat_thickness, chair.back_height, 7)
    return [_upright(chair, side, heights, section) for side in (-1, 1)]


def _slats(chair) -> list[Manifold]:
    """Flat vertical boards between two rails."""
    low, high = 0.16 * chair.back_height, chair.back_height - 0.03
    made = [_rail(chair, low, 0.035, _RAIL), _rail(chair, high, 0.06, _RAIL + 0.006)]
    width = min(0.05, 0.9 * chair.seat_width / (chair.slats + 1) * 0.6)
    board, heights = parts.rounded_rectangle(width, 0.014, 0.004), np.linspace(low, high, 5)
    return made + [_upright(chair, side, heights, board) for side in _inner_sides(chair)]


def _spindles(chair) -> list[Manifold]:
    """Turned rods from the seat into a crest rail."""
    high = chair.back_height - 0.02
    return [_rail(chair, high, 0.075, _RAIL + 0.004, crest=0.025), *_rods(chair, [high] * chair.slats)]


def _ladder(chair) -> list[Manifold]:
    """Bowed horizontal slats between the posts."""
    count = max(2, chair.slats - 2)
    heights = np.linspace(0.28, 1, count) * chair.back_height - 0.035
    tall = min(0.07, 0.55 * (heights[1] - heights[0]))
    return [_rail(chair, h, tall, 0.02, crest=0.014) for h in heights]


def _shell(chair) -> list[Manifold]:
    """A curved board with rounded upper corners, held clear of the seat; a solid one grows out of it."""
    low, fall = 0.38 * chair.back_height, 0.03
    if chair.back == "solid":
        low, fall = -0.4 * chair.seat_thickness, 0.3 * chair.back_height
    sections, half = [], np.array([0, chair.back_thickness / 2, 0])
    for side in np.linspace(-1.04, 1.04, 17):
        top = chair.back_height - fall * np.abs(side / 1.04) ** 6
        front = [point(chair, side, h) - half for h in np.linspace(low, top, 6)]
        rear = [point(chair, side, h) + half for h in np.linspace(top, low, 6)]
        sections.append(front + rear)
    return [parts.loft(sections)]


def _hoop(chair) -> list[Manifold]:
    """A bent bow with rods inside it."""
    angle, power = np.linspace(0, np.pi, 29), 2 / 2.6
    sides = np.sign(np.cos(angle)) * np.abs(np.cos(angle)) ** power
    heights = chair.back_height * np.sin(angle) ** power
    path = [point(chair, s, h) for s, h in zip(sides, heights, strict=True)]
    root = np.array([0, 0, -0.5 * chair.seat_thickness])
    bow = np.array([path[0] + root, *path, path[-1] + root])
    made = [parts.tube(bow, max(0.42 * chair.leg_width, 0.0125), 12, up=(0, 1, 0))]
    tops = [chair.back_height * (1 - abs(side) ** 2.6) ** (1 / 2.6) for side in _inner_sides(chair)]
    return made + _rods(chair, tops)
