"""Aircraft: airliners, business jets, turboprops, light singles, gliders, fighters; one set of parameters."""

from dataclasses import replace
from types import SimpleNamespace
from typing import ClassVar, NamedTuple

import numpy as np
from manifold3d import Manifold

from sdfhub.procedural import parts, plane_engines
from sdfhub.procedural import plane_parts as pp


class Proportions(NamedTuple):
    """What makes a kind of aircraft that kind; lengths in fuselage lengths, angles in degrees."""

    length: float  # metres
    span: float
    chord: float
    taper: float
    sweep: float
    wing: float  # y of the wing's root, leading edge
    tail_size: float
    clearance: float  # from the belly to the ground
    wheel: float


KINDS = {
    "airliner": Proportions(38, 0.96, 0.22, 0.26, 31, -0.13, 1.0, 0.06, 0.019),
    "business jet": Proportions(18, 0.94, 0.2, 0.32, 28, -0.06, 1.0, 0.05, 0.018),
    "turboprop": Proportions(25, 1.08, 0.13, 0.5, 4, -0.1, 1.05, 0.06, 0.021),
    "single": Proportions(8, 1.3, 0.18, 0.72, 2, -0.2, 1.1, 0.085, 0.031),
    "glider": Proportions(7, 1.75, 0.125, 0.42, 1.5, -0.16, 1.0, 0.014, 0.03),
    "fighter": Proportions(15, 0.66, 0.4, 0.16, 46, -0.06, 1.05, 0.055, 0.022),
}
BODIES = {
    "airliner": pp.Fuselage(0.052, 1, 0.12, 0.38, 0.06, 0.16, 0.55, 1.15, 2),
    "business jet": pp.Fuselage(0.06, 1, 0.2, 0.42, 0.07, 0.18, 0.62, 1.1, 2),
    "turboprop": pp.Fuselage(0.056, 1.05, 0.14, 0.4, 0.1, 0.2, 0.55, 1.1, 2.2),
    "single": pp.Fuselage(0.07, 1.12, 0.16, 0.62, 0.62, 0.2, 0.5, 0.9, 2.7),
    "glider": pp.Fuselage(0.058, 1.15, 0.24, 0.6, 0.1, 0.3, 0.6, 0.75, 2.1),
    "fighter": pp.Fuselage(0.054, 1.0, 0.36, 0.3, 0.05, 0.8, 0.75, 1.0, 2.4),
}


class Plane(SimpleNamespace):
    """One aircraft, its nose towards -y. Numbers scale or shift the proportions of its kind; what a kind
    cannot have is read as its nearest: a jet with a tail wheel stands on a nose wheel."""

    parameters: ClassVar = dict(
        kind=list(KINDS), mount=["low", "low", "mid", "high", "high"],
        tail=["conventional", "conventional", "t", "v", "twin", "cruciform"],
        gear=["tricycle", "taildragger", "retracted", "retracted"], tips=["plain", "winglet", "tank"],
        engines=[1, 1, 2], blades=[2, 3, 4], spats=[True, False], size=(0.8, 1.25), girth=(0.88, 1.15),
        nose_length=(0.8, 1.3), nose_droop=(0.0, 0.45), upsweep=(0.3, 0.9), span=(0.88, 1.12),
        chord=(0.88, 1.15), taper=(0.8, 1.25), sweep=(-4.0, 7.0), dihedral=(1.0, 6.5),
        wing_shift=(-0.03, 0.03), tail_size=(0.88, 1.15), fin_sweep=(-8.0, 10.0), engine_size=(0.88, 1.15),
        engine_shift=(-0.04, 0.05), canopy_height=(0.85, 1.25), winglet_height=(0.1, 0.17),
        blade_turn=(0.0, 90.0),
    )  # fmt: skip

    def build(self) -> Manifold:
        """The aircraft as one solid."""
        self._measure()
        body = self.body.solid()
        if self.kind in ("airliner", "business jet", "turboprop"):
            body = self._windscreen(body)
        solids = [body, *self._wing(), *_tail(self), *plane_engines.powerplant(self)]
        whole = parts.union([*solids, *self._canopy(), *plane_engines.gear(self)])
        return whole.scale((self.base.length * self.size,) * 3)

    def _measure(self) -> None:
        """Sets what several parts share: proportions, fuselage, least thickness, half span, sweeps."""
        self.base, b = KINDS[self.kind], BODIES[self.kind]
        # A share of the bounding radius, so that the thinnest parts can be sampled.
        self.gauge = 0.0092 * max(1.06, self.base.span * self.span)
        upsweep = 0.4 * self.upsweep if self.kind in ("fighter", "single") else self.upsweep
        nose, radius = b.nose * self.nose_length, b.radius * self.girth
        end = max(b.end, 1.3 * self.gauge / radius)
        self.body = replace(b, radius=radius, nose=nose, end=end, upsweep=upsweep, droop=self.nose_droop)
        self.semi_span = self.base.span * self.span / 2
        straight = self.kind in ("turboprop", "single", "glider")
        self.wing_sweep = self.base.sweep + (0.3 if straight else 1.0) * self.sweep
        fast = self.kind in ("airliner", "business jet", "fighter")
        self.fin_angle = (40 if fast else 24) + self.fin_sweep
        self.tail_angle = (34 if fast else 8) + 0.5 * self.fin_sweep
        self.tail_scale = self.base.tail_size * self.tail_size

    def leading_edge(self, share: float) -> np.ndarray:
        """[3] point of the right wing's leading edge; share 0 is the centre line, 1 the tip."""
        x = share * self.semi_span
        y = self.base.wing + self.wing_shift + x * np.tan(np.radians(self.wing_sweep))
        half, high = self.body.half_height(0), {"low": -0.62, "mid": 0.0, "high": 0.72}[self.mount]
        if self.kind == "single" and self.mount == "high":
            high = 1 + 0.38 * self.canopy_height
        if self.kind == "fighter":
            high *= 0.6
        fall = -0.35 if self.mount == "high" and self.kind != "glider" else 1.0
        return np.array([x, y, half * high + x * np.tan(np.radians(fall * self.dihedral))])

    def wing_chord(self, share: float) -> float:
        """Chord of the wing; an airliner's inner trailing edge runs straight out to its kink."""
        root = self.base.chord * self.chord
        tip = root * self.base.taper * self.taper
        if self.kind not in ("airliner", "business jet"):
            return root + share * (tip - root)
        kink = max(root - 0.95 * 0.36 * self.semi_span * np.tan(np.radians(self.wing_sweep)), 1.25 * tip)
        return float(np.interp(share, [0, 0.36, 1], [root, kink, tip]))

    def wing_point(self, share: float, along: float = 0.4) -> np.ndarray:
        """[3] point inside the right wing, `along` chords behind its leading edge."""
        return self.leading_edge(share) + [0, along * self.wing_chord(share), 0]

    def _wing(self) -> list[Manifold]:
        roll = np.arctan2(*(self.leading_edge(1) - self.leading_edge(0))[[2, 0]])
        half = [(self.leading_edge(s), self.wing_chord(s), roll) for s in (0.36, 0.7, 0.97)]
        half += self._wing_tip(roll)
        left = [(edge * [-1, 1, 1], chord, -turn) for edge, chord, turn in reversed(half)]
        middle = self.leading_edge(0), self.wing_chord(0), 0.0
        ratio = 0.06 if self.kind == "fighter" else 0.13
        wing = pp.lifting_surface([*left, middle, *half], ratio, self.gauge, 0.0 if ratio < 0.1 else 0.015)
        if self.tips != "tank" or self.kind in ("airliner", "glider"):
            return [wing]
        r, a = 1.25 * self.gauge, 1.5 * max(self.wing_chord(1), 0.09)
        shape = [(0.15, -0.5), (0.6, -0.42), (0.95, -0.28), (1, 0), (0.9, 0.25), (0.5, 0.43), (0.2, 0.5)]
        tank = pp.body_of_revolution(shape, self.wing_point(0.99, 0.5), r, a, 16)
        return [wing, *parts.mirrored(tank)]

    def _wing_tip(self, roll: float) -> list[tuple[np.ndarray, float, float]]:
        """Sections beyond 97% of the half span: rounded off, or turned up into a winglet."""
        tip, chord = self.leading_edge(1), self.wing_chord(1)
        if self.tips != "winglet" or self.kind in ("fighter", "single"):
            return [(tip + [0, 0.12 * chord, 0], 0.8 * chord, roll)]
        tall, stations = self.winglet_height * self.semi_span, []
        for up, out, trim, turn in ((0.06, 0.12, 0.06, 0.45), (0.22, 0.24, 0.2, 0.9), (1.0, 0.5, 0.8, 1.0)):
            point = tip + np.array([out * tall, trim * min(chord, tall), up * tall])
            stations.append((point, chord * (1 - 0.55 * trim), roll + turn * (1.2 - roll)))
        return stations

    def _windscreen(self, body: Manifold) -> Manifold:
        """The nose with its upper front cut flat, as by the panes of a flight deck."""
        across = np.array([np.sin(0.8), -np.cos(0.8)])
        along = np.linspace(-0.5, -0.5 + self.body.nose, 60)
        nearest = min(across @ [y, self.body.top(y)] for y in along)
        return body.trim_by_plane((0.0, *across), nearest + 0.17 * self.body.radius)

    def _canopy(self) -> list[Manifold]:
        """A bubble over the cockpit, or the fairing where an airliner's wing meets its body."""
        body, tall = self.body, self.canopy_height * self.body.half_height(0)
        front = -0.5 + 0.55 * body.nose
        if self.kind == "single":
            front, rear = -0.5 + body.nose + 0.03, 0.16 if self.mount == "high" else 0.1
            peak, foot, wide, high = 0.42, 0.35, 0.86, tall * 0.75 + 0.4 * body.half_height(0)
        elif self.kind in ("glider", "fighter"):
            rear = front + (0.24 if self.kind == "fighter" else 0.2)
            peak, foot, wide, high = 0.4, 0.4, 0.62, 0.85 * tall
        else:
            radii = 0.92 * body.radius, 0.75 * self.wing_chord(0), 0.5 * body.radius
            return [parts.ellipsoid(radii, self.wing_point(0, 0.5) * [0, 1, 0.95], 20)]
        return [pp.canopy(body, front, rear, peak, foot, wide * body.radius, high)]


def _tail(plane) -> list[Manifold]:
    """The plane's fins and tailplanes; engines at the rear push a low tailplane up to the fin's top."""
    style, is_fighter = plane.tail, plane.kind == "fighter"
    if plane.kind == "business jet" and style in ("conventional", "twin"):
        style = "t"
    if style == "v":
        return _low_tailplane(plane, 0.48, np.radians(38), 0.22, 0.14)
    if style == "twin" and not is_fighter:
        return _twin(plane)
    chord = (0.19 if is_fighter else 0.155) * plane.tail_scale
    y = 0.485 - chord
    root = np.array([0, y, plane.body.axis(0.47)])
    height = plane.body.half_height(y) + 0.125 * plane.tail_scale
    fins = [_surface(plane, root, (0, 1), height, chord, plane.fin_angle)]
    if style in ("twin", "conventional"):
        fins = _fighter_fins(plane) if style == "twin" else fins
        return fins + _low_tailplane(plane, 0.49, 0.06, 0.19, 0.17 if is_fighter else 0.125)
    if is_fighter and style == "cruciform":  # canards behind the cockpit instead of a tailplane
        root = np.array([-0.004, -0.31, plane.body.axis(-0.26) + 0.3 * plane.body.half_height(-0.26)])
        return fins + _tailplane(plane, root, 0.05, 0.15 * plane.tail_scale, 0.1)
    share = 0.5 if style == "cruciform" else 0.93  # of the fin's height
    back = share * height * np.tan(np.radians(plane.fin_angle))
    raised = root + np.array([-0.004, back - 0.01, share * height])
    return fins + _tailplane(plane, raised, 0.0, 0.17 * plane.tail_scale, max(0.62 * chord, 0.09))


def _surface(plane, root, direction, length: float, chord: float, sweep: float, taper: float = 0.55):
    return pp.panel(root, direction, length, (chord, taper * chord), sweep, 0.1, plane.gauge)


def _tailplane(plane, root, roll: float, length: float, chord: float) -> list[Manifold]:
    """A surface and its mirror image, both from the centre line."""
    direction = np.cos(roll), np.sin(roll)
    return parts.mirrored(_surface(plane, root, direction, length, chord, plane.tail_angle))


def _low_tailplane(plane, rear: float, roll: float, length: float, chord: float) -> list[Manifold]:
    """A tailplane, or a V-tail, that ends at y = `rear`."""
    length, chord = length * plane.tail_scale, chord * plane.tail_scale
    root = np.array([-0.006 if plane.tail == "v" else -0.004, rear - chord, plane.body.axis(0.46)])
    return _tailplane(plane, root, roll, length, chord)


def _twin(plane) -> list[Manifold]:
    """A low tailplane with a fin on each of its tips."""
    length, chord = 0.17 * plane.tail_scale, 0.12 * plane.tail_scale
    root = np.array([-0.004, 0.48 - chord, plane.body.axis(0.46)])
    low = root + np.array([length - 0.004, 0.0, -0.045 * plane.tail_scale])
    flat = _surface(plane, root, (1, 0), length, chord, 4, 0.9)
    fin = _surface(plane, low, (0, 1), 0.14 * plane.tail_scale, chord, 14, 0.7)
    return parts.mirrored(flat) + parts.mirrored(fin)


def _fighter_fins(plane) -> list[Manifold]:
    """Two canted fins on the body's shoulders."""
    chord, cant, body = 0.165 * plane.tail_scale, np.radians(74), plane.body
    y = 0.47 - chord
    root = np.array([0.5 * body.half_width(0.4), y, body.axis(0.45) + 0.1 * body.radius])
    height, direction = body.half_height(y) + 0.1 * plane.tail_scale, (np.cos(cant), np.sin(cant))
    return parts.mirrored(_surface(plane, root, direction, height, chord, plane.fin_angle, 0.5))
