"""Chairs: dining, Windsor, ladder-back, bentwood, cantilever, swivel, tulip, from one set of parameters."""

from types import SimpleNamespace
from typing import ClassVar

import numpy as np
from manifold3d import Manifold

from sdfhub.procedural import parts

_RAIL = 0.022  # thickness of rails and posts of light backs


class Chair(SimpleNamespace):
    """One chair. Lengths in metres; seat, back and legs combine freely."""

    parameters: ClassVar = dict(
        seat_height=(0.4, 0.5), seat_width=(0.4, 0.56), seat_depth=(0.38, 0.5),
        seat_thickness=(0.025, 0.075), seat_taper=(0.74, 0.98), back_height=(0.34, 0.62),
        back_lean=(0.03, 0.14), back_curve=(0.0, 0.07), back_thickness=(0.018, 0.05),
        leg_width=(0.028, 0.046), leg_taper=(0.5, 0.95), leg_splay=(0.0, 0.075),
        stretcher_height=(0.22, 0.5), arm_height=(0.17, 0.25), spindle_width=(0.017, 0.025),
        seat=["square", "tapered", "round"], back=["slats", "spindles", "ladder", "solid", "hoop", "panel"],
        legs=["square", "square", "turned", "round", "round", "sled", "cantilever", "star", "tulip"],
        arms=["none", "none", "none", "straight", "curved"],
        stretchers=["none", "none", "sides", "h", "box"], apron=[True, False], slats=[3, 4, 5, 6, 7],
    )  # fmt: skip

    def build(self) -> Manifold:
        """The chair as one solid, standing on z = 0."""
        top, thick = self.seat_height, self.seat_thickness
        bases = dict(sled=self._sled, cantilever=self._cantilever, star=self._star, tulip=self._tulip)
        base = bases.get(self.legs, self._four_legs)
        made = [parts.pad(self._outline(), top - thick, top, 0.4 * thick), *base()]
        return parts.union([*made, *_back(self), *self._arms()])

    def _outline(self) -> np.ndarray:
        """[N, 2] of the seat, its front at -y."""
        width, depth = self.seat_width, self.seat_depth
        if self.seat == "round":
            return parts.circle(40) * np.array([width, depth]) / 2
        if self.seat == "tapered":
            return parts.rounded_rectangle(width, depth, 0.05, width * self.seat_taper)
        return parts.rounded_rectangle(width, depth, 0.02)

    def half_width(self, y: float) -> float:
        """Half the seat's width at depth y."""
        along = y / self.seat_depth + 0.5
        if self.seat == "round":
            return self.seat_width / 2 * np.sqrt(max(0.0, 1 - (2 * along - 1) ** 2))
        taper = self.seat_taper if self.seat == "tapered" else 1.0
        return self.seat_width / 2 * (1 - along * (1 - taper))

    def _four_legs(self) -> list[Manifold]:
        """Legs in the corners, front left first, and the boards and bars between them."""
        z, inset = self.seat_height - 0.4 * self.seat_thickness, 0.7 * self.leg_width
        reach = 0.32 if self.seat == "round" else 0.5
        ends = []
        for y in (-reach * self.seat_depth + inset, reach * self.seat_depth - inset):
            for side in (-1, 1):
                x = side * (self.half_width(y) - inset * 1.1)
                foot = (x + side * self.leg_splay * 0.7, y + np.sign(y) * self.leg_splay, 0.0)
                ends.append((np.array([x, y, z]), np.array(foot)))
        made = [self._leg(top, foot) for top, foot in ends]
        if self.apron and self.legs != "round":
            z = self.seat_height - self.seat_thickness - 0.045 / 2 + 0.008
            made += parts.aprons(ends, z, 0.018, 0.045 + 0.016)
        radii = None if self.legs == "square" else (0.009, 0.013)
        return made + parts.stretchers(ends, self.stretcher_height, self.stretchers, (0.018, 0.026), radii)

    def _leg(self, top: np.ndarray, foot: np.ndarray) -> Manifold:
        w = self.leg_width
        if self.legs == "square":
            return parts.square_bar(foot, top, w * self.leg_taper, w)
        if self.legs == "round":
            return parts.bar(foot, top, 0.5 * w * self.leg_taper, 0.55 * w)
        profile = [(0.6, 0), (0.75, 0.03), (0.6, 0.07), (0.5, 0.1), (0.62 + 0.2 * self.leg_taper, 0.3)]
        profile += [(0.95, 0.5), (0.95, 0.56), (0.55, 0.6), (0.9, 0.63), (0.9, 0.65), (0.55, 0.68)]
        return parts.turned(foot, top, [*profile, (0.95, 0.72), (1, 0.76), (1, 1)], 0.56 * w)

    def _sled(self) -> list[Manifold]:
        """Two closed loops of tube, one a side, joined by bars under the seat."""
        r, z = 0.34 * self.leg_width, self.seat_height - 0.6 * self.seat_thickness
        reach = 0.30 if self.seat == "round" else 0.44
        made = []
        for side in (-1, 1):
            ys = self.seat_depth * reach * np.array([-1, 1])
            top = np.array([(side * (self.half_width(y) - 1.5 * r), y, z) for y in ys])
            out = np.array([side * 0.4 * self.leg_splay, 0, 0])
            floor = top + out + np.array([[0, -0.5 * self.leg_splay - 0.01, r - z], [0, 0.06, r - z]])
            path = parts.filleted([top[0], floor[0], floor[1], top[1]], 0.05)
            made.append(parts.tube(path, r, up=(1, 0, 0)))
        return made

    def _cantilever(self) -> list[Manifold]:
        """A bent tube: along the floor, up at the front, back below the seat."""
        r, z = 0.36 * self.leg_width, self.seat_height - 0.75 * self.seat_thickness
        front, back = -self.seat_depth / 2 - self.leg_splay / 2, self.seat_depth * 0.5
        depth = self.seat_depth
        x = min(self.half_width(0.25 * depth), self.half_width(-0.25 * depth)) - 1.2 * r
        corners = [(x, back, r), (x, front, r), (x, front, z), (x, 0.25 * depth, z)]
        made = parts.mirrored(parts.tube(parts.filleted(corners, 0.09, 6), r, up=(1, 0, 0)))
        places = (back - r, r), (0.1 * depth, z)
        return made + [parts.bar((-x, y, height), (x, y, height), r) for y, height in places]

    def _star(self) -> list[Manifold]:
        """A gas lift on five castors."""
        z, reach = self.seat_height - 0.5 * self.seat_thickness, 0.26 + 0.6 * self.leg_splay
        column = [(0.026, 0.075), (0.026, 0.62 * z), (0.017, 0.62 * z + 0.01), (0.017, z)]
        hub = [(0.038, 0.07), (0.042, 0.1), (0.026, 0.14)]
        plate = [(0.03, z - 0.06), (0.11, z - 0.02), (0.11, z)]
        made = [parts.lathe(profile) for profile in (column, hub, plate)]
        for out in parts.spokes(5):
            tip = reach * out + np.array([0, 0, 0.062])
            made.append(parts.bar((0, 0, 0.1), tip, 0.62 * self.leg_width, 0.42 * self.leg_width))
            made.append(parts.ellipsoid((0.03, 0.03, 0.03), tip - np.array([0, 0, 0.032]), 16))
            made.append(parts.ellipsoid((0.018, 0.018, 0.02), tip, 12))
        return made

    def _tulip(self) -> list[Manifold]:
        """A disc that flares into one stem and opens below the seat."""
        z, foot = self.seat_height - 0.5 * self.seat_thickness, 0.2 + self.leg_splay
        stem, t = 0.7 * self.leg_width, np.linspace(0, 1, 14)
        radius = stem + (foot - stem) * (1 - t) ** 5 + (0.42 * foot - stem) * t**7
        height = 0.018 + (z - 0.018) * t
        return [parts.lathe([(foot, 0.0), *zip(radius, height, strict=True)], 32)]

    def _arms(self) -> list[Manifold]:
        if self.arms == "none":
            return []
        is_hoop, share = self.back == "hoop", self.arm_height / self.back_height
        outermost = (1 - share**2.6) ** (1 / 2.6) if is_hoop else 1.0  # post at the arm's height
        behind = _back_point(self, outermost, self.arm_height)
        y = -0.24 * self.seat_depth
        x, z = self.half_width(y) - 0.024, self.seat_height + self.arm_height
        seat = np.array([x, y, self.seat_height - 0.4 * self.seat_thickness])
        wide = max(x, behind[0]) + 0.02
        if self.arms == "curved":
            corners: list[parts.Point] = [behind, (wide, 0.3 * y, z + 0.01), (wide, y - 0.05, z - 0.01), seat]
            path = parts.filleted(corners, 0.06, 5)
            return parts.mirrored(parts.tube(path, 0.4 * self.leg_width, up=(1, 0, 0.2)))
        rest = parts.plank(behind + [0, 0.01, 0], (x, y - 0.05, z), 0.045, 0.024)
        return [*parts.mirrored(rest), *parts.mirrored(parts.square_bar(seat, (x, y, z), 0.03))]


def _back(chair) -> list[Manifold]:
    """The parts of the backrest, rooted in the seat and built along a surface that leans and bows."""
    styles = dict(slats=_slats, spindles=_spindles, ladder=_ladder, panel=_shell, solid=_shell, hoop=_hoop)
    posts = [] if chair.back in ("solid", "hoop") else _posts(chair)
    return [*posts, *styles[chair.back](chair)]


def _back_point(chair, side: float, height: float) -> np.ndarray:
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


def _inner_sides(chair) -> np.ndarray:
    """Where slats and rods stand between the posts, as the `side` of `_back_point`."""
    return np.linspace(-1, 1, chair.slats + 2)[1:-1]


def _upright(chair, side: float, heights: np.ndarray, section: np.ndarray) -> Manifold:
    """A bar along the back's surface through some heights."""
    return parts.sweep([_back_point(chair, side, h) for h in heights], section, up=(0, 1, 0))


def _rods(chair, tops) -> list[Manifold]:
    """Thin round bars from the seat to heights, one a place between the posts."""
    section, low = chair.spindle_width / 2 * parts.circle(10), -0.5 * chair.seat_thickness
    rods = zip(_inner_sides(chair), tops, strict=True)
    return [_upright(chair, side, np.linspace(low, top, 7), section) for side, top in rods]


def _rail(chair, height: float, tall: float, thick: float, crest: float = 0.0) -> Manifold:
    """A curved rail from post to post; `crest` raises its middle."""
    path = [_back_point(chair, s, height + crest * (1 - s * s)) for s in np.linspace(-1, 1, 13)]
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
        front = [_back_point(chair, side, h) - half for h in np.linspace(low, top, 6)]
        rear = [_back_point(chair, side, h) + half for h in np.linspace(top, low, 6)]
        sections.append(front + rear)
    return [parts.loft(sections)]


def _hoop(chair) -> list[Manifold]:
    """A bent bow with rods inside it."""
    angle, power = np.linspace(0, np.pi, 29), 2 / 2.6
    sides = np.sign(np.cos(angle)) * np.abs(np.cos(angle)) ** power
    heights = chair.back_height * np.sin(angle) ** power
    path = [_back_point(chair, s, h) for s, h in zip(sides, heights, strict=True)]
    root = np.array([0, 0, -0.5 * chair.seat_thickness])
    bow = np.array([path[0] + root, *path, path[-1] + root])
    made = [parts.tube(bow, max(0.42 * chair.leg_width, 0.0125), 12, up=(0, 1, 0))]
    tops = [chair.back_height * (1 - abs(side) ** 2.6) ** (1 / 2.6) for side in _inner_sides(chair)]
    return made + _rods(chair, tops)
