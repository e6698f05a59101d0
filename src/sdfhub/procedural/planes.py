"""Aircraft: airliners, business jets, turboprops, light singles, gliders, fighters; one set of parameters."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from manifold3d import Manifold

from sdfhub.procedural import parts, plane_engines, plane_gear, plane_tails
from sdfhub.procedural import plane_parts as pp
from sdfhub.procedural.parameters import choice, continuous


class Proportions(NamedTuple):
    """What makes a kind of aircraft that kind; lengths in fuselage lengths, angles in degrees."""

    length: float  # metres
    body: pp.Fuselage
    span: float
    chord: float
    taper: float
    sweep: float
    wing: float  # y of the wing's root, leading edge
    tail_size: float
    clearance: float  # from the belly to the ground
    wheel: float


KINDS = {
    "airliner": Proportions(
        38,
        pp.Fuselage(0.052, 1, 0.12, 0.38, 0.06, 0.16, 0.55, 1.15, 2),
        0.96,
        0.22,
        0.26,
        31,
        -0.13,
        1.0,
        0.06,
        0.019,
    ),
    "business jet": Proportions(
        18,
        pp.Fuselage(0.06, 1, 0.2, 0.42, 0.07, 0.18, 0.62, 1.1, 2),
        0.94,
        0.2,
        0.32,
        28,
        -0.06,
        1.0,
        0.05,
        0.018,
    ),
    "turboprop": Proportions(
        25,
        pp.Fuselage(0.056, 1.05, 0.14, 0.4, 0.1, 0.2, 0.55, 1.1, 2.2),
        1.08,
        0.13,
        0.5,
        4,
        -0.1,
        1.05,
        0.06,
        0.021,
    ),
    "single": Proportions(
        8,
        pp.Fuselage(0.07, 1.12, 0.16, 0.62, 0.62, 0.2, 0.5, 0.9, 2.7),
        1.3,
        0.18,
        0.72,
        2,
        -0.2,
        1.1,
        0.085,
        0.031,
    ),
    "glider": Proportions(
        7,
        pp.Fuselage(0.058, 1.15, 0.24, 0.6, 0.1, 0.3, 0.6, 0.75, 2.1),
        1.75,
        0.125,
        0.42,
        1.5,
        -0.16,
        1.0,
        0.014,
        0.03,
    ),
    "fighter": Proportions(
        15,
        pp.Fuselage(0.054, 1.0, 0.36, 0.3, 0.05, 0.8, 0.75, 1.0, 2.4),
        0.66,
        0.4,
        0.16,
        46,
        -0.06,
        1.05,
        0.055,
        0.022,
    ),
}


@dataclass(frozen=True)
class Plane:
    """One aircraft, its nose towards -y. Numbers scale or shift the proportions of its kind; what a kind
    cannot have is read as its nearest: a jet with a tail wheel stands on a nose wheel."""

    kind: str = choice(*KINDS)
    mount: str = choice("low", "low", "mid", "high", "high")
    tail: str = choice("conventional", "conventional", "t", "v", "twin", "cruciform")
    gear: str = choice("tricycle", "taildragger", "retracted", "retracted")
    tips: str = choice("plain", "winglet", "tank")
    engines: int = choice(1, 1, 2)
    blades: int = choice(2, 3, 4)
    spats: bool = choice(True, False)
    size: float = continuous(0.8, 1.25)
    girth: float = continuous(0.88, 1.15)
    nose_length: float = continuous(0.8, 1.3)
    nose_droop: float = continuous(0.0, 0.45)
    upsweep: float = continuous(0.3, 0.9)
    span: float = continuous(0.88, 1.12)
    chord: float = continuous(0.88, 1.15)
    taper: float = continuous(0.8, 1.25)
    sweep: float = continuous(-4.0, 7.0)
    dihedral: float = continuous(1.0, 6.5)
    wing_shift: float = continuous(-0.03, 0.03)
    tail_size: float = continuous(0.88, 1.15)
    fin_sweep: float = continuous(-8.0, 10.0)
    engine_size: float = continuous(0.88, 1.15)
    engine_shift: float = continuous(-0.04, 0.05)
    canopy_height: float = continuous(0.85, 1.25)
    winglet_height: float = continuous(0.1, 0.17)
    blade_turn: float = continuous(0.0, 90.0)

    def build(self) -> Manifold:
        """The aircraft as one solid."""
        body = self.body.solid()
        if self.kind in ("airliner", "business jet", "turboprop"):
            body = self._windscreen(body)
        solids = [body, *self._wing(), *plane_tails.tail(self), *plane_engines.powerplant(self)]
        whole = parts.union([*solids, *self._canopy(), *plane_gear.gear(self)])
        return whole.scale((self.base.length * self.size,) * 3)

    @property
    def base(self) -> Proportions:
        """The proportions of its kind."""
        return KINDS[self.kind]

    @property
    def gauge(self) -> float:
        """Thickness of its thinnest parts: a share of the bounding radius, so that they can be sampled."""
        return 0.0092 * max(1.06, self.base.span * self.span)

    @property
    def body(self) -> pp.Fuselage:
        """Its fuselage."""
        b = self.base.body
        upsweep = 0.4 * self.upsweep if self.kind in ("fighter", "single") else self.upsweep
        nose, radius = b.nose * self.nose_length, b.radius * self.girth
        end = max(b.end, 1.3 * self.gauge / radius)
        return replace(b, radius=radius, nose=nose, end=end, upsweep=upsweep, droop=self.nose_droop)

    @property
    def semi_span(self) -> float:
        """From the centre line to the wing's tip."""
        return self.base.span * self.span / 2

    def leading_edge(self, share: float) -> np.ndarray:
        """[3] point of the right wing's leading edge; share 0 is the centre line, 1 the tip."""
        x = share * self.semi_span
        y = self.base.wing + self.wing_shift + x * np.tan(np.radians(self._sweep))
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
        kink = max(root - 0.95 * 0.36 * self.semi_span * np.tan(np.radians(self._sweep)), 1.25 * tip)
        return float(np.interp(share, [0, 0.36, 1], [root, kink, tip]))

    def wing_point(self, share: float, along: float = 0.4) -> np.ndarray:
        """[3] point inside the right wing, `along` chords behind its leading edge."""
        return self.leading_edge(share) + [0, along * self.wing_chord(share), 0]

    @property
    def _sweep(self) -> float:
        straight = self.kind in ("turboprop", "single", "glider")
        return self.base.sweep + (0.3 if straight else 1.0) * self.sweep

    def _wing(self) -> list[Manifold]:
        roll = np.arctan2(*(self.leading_edge(1) - self.leading_edge(0))[[2, 0]])
        half = [pp.Station(self.leading_edge(s), self.wing_chord(s), roll) for s in (0.36, 0.7, 0.97)]
        half += self._wing_tip(roll)
        left = [pp.Station(s.leading_edge * np.array([-1, 1, 1]), s.chord, -s.roll) for s in reversed(half)]
        middle = pp.Station(self.leading_edge(0), self.wing_chord(0))
        ratio = 0.06 if self.kind == "fighter" else 0.13
        wing = pp.lifting_surface([*left, middle, *half], ratio, self.gauge, 0.0 if ratio < 0.1 else 0.015)
        if self.tips != "tank" or self.kind in ("airliner", "glider"):
            return [wing]
        r, a = 1.25 * self.gauge, 1.5 * max(self.wing_chord(1), 0.09)
        shape = [(0.15, -0.5), (0.6, -0.42), (0.95, -0.28), (1, 0), (0.9, 0.25), (0.5, 0.43), (0.2, 0.5)]
        tank = pp.body_of_revolution(parts.scaled(shape, r, a), self.wing_point(0.99, 0.5), 16)
        return [wing, *parts.mirrored(tank)]

    def _wing_tip(self, roll: float) -> list[pp.Station]:
        """Sections beyond 97% of the half span: rounded off, or turned up into a winglet."""
        tip, chord = self.leading_edge(1), self.wing_chord(1)
        if self.tips != "winglet" or self.kind in ("fighter", "single"):
            return [pp.Station(tip + [0, 0.12 * chord, 0], 0.8 * chord, roll)]
        tall, stations = self.winglet_height * self.semi_span, []
        for up, out, trim, turn in ((0.06, 0.12, 0.06, 0.45), (0.22, 0.24, 0.2, 0.9), (1.0, 0.5, 0.8, 1.0)):
            point = tip + np.array([out * tall, trim * min(chord, tall), up * tall])
            stations.append(pp.Station(point, chord * (1 - 0.55 * trim), roll + turn * (1.2 - roll)))
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

        def base(y: float) -> float:
            return body.axis(y) + foot * body.half_height(y)

        return [pp.canopy(front, rear, peak, base, wide * body.radius, high)]
