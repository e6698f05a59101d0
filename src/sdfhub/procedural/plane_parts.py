"""What aircraft are made of: a fuselage, lifting surfaces, nacelles, propellers, wheels.

Lengths are in fuselage lengths: the nose is at y = -0.5 and the tail at y = 0.5.
"""

from dataclasses import dataclass

import numpy as np
from manifold3d import Manifold

from sdfhub.procedural import parts

# Places along an aerofoil of unit chord and thickness, and half its thickness there (NACA report 460).
_ALONG = (1 - np.cos(np.linspace(0, np.pi, 9))) / 2
_POWERS = np.stack([np.sqrt(_ALONG), _ALONG, _ALONG**2, _ALONG**3, _ALONG**4])
_HALF = 5 * np.array([0.2969, -0.126, -0.3516, 0.2843, -0.1036]) @ _POWERS


@dataclass(frozen=True)
class Fuselage:
    """A body along y whose section is a superellipse."""

    radius: float  # half the width of the cabin
    tall: float  # height over width
    nose: float  # length over which the section grows
    tail: float  # length over which it shrinks
    tip: float  # section at the nose as a share of the cabin's
    end: float  # section at the tail, likewise
    bluntness: float  # exponent of the nose; 0.5 is an ellipse, 0.9 nearly a cone
    boom: float  # exponent of the tail; above 1 the body stays full for longer, below 1 it thins out early
    square: float  # exponent of the section; 2 is an ellipse
    upsweep: float = 0  # rise of the tail's axis; at 1 the roof stays level
    droop: float = 0  # fall of the nose's axis, likewise

    def share(self, y: float) -> float:
        """The section at y as a share of the cabin's."""
        ahead, behind = self._phases(y)
        nose = self.tip + (1 - self.tip) * (1 - ahead**2) ** self.bluntness
        smooth = behind * behind * (3 - 2 * behind)
        return nose * (1 - (1 - self.end) * smooth**self.boom)

    def half_width(self, y: float) -> float:
        """Half the width at y."""
        return self.radius * self.share(y)

    def half_height(self, y: float) -> float:
        """Half the height at y."""
        return self.tall * self.radius * self.share(y)

    def axis(self, y: float) -> float:
        """Height of the section's centre at y; 0 in the cabin."""
        ahead, behind = self._phases(y)
        missing = self.tall * self.radius * (1 - self.share(y))
        return missing * (self.upsweep * (behind > 0) - self.droop * (ahead > 0))

    def top(self, y: float) -> float:
        """Height of the roof at y."""
        return self.axis(y) + self.half_height(y)

    def solid(self, segments: int = 24) -> Manifold:
        """The body, its nose and tail closed by small discs."""
        stretch = np.linspace(0.07, 1, 10) ** 2
        nose, tail = -0.5 + self.nose * stretch, 0.5 - self.tail * np.linspace(1, 0, 11)
        body = [self._ring(y, segments) for y in (*nose, *tail[tail > nose[-1] + 0.005])]
        cap = self._ring(0.5, segments)
        centre = cap.mean(0)
        for share in (0.8, 0.4):
            body.append(centre + (cap - centre) * share + [0, 0.6 * self.radius * self.end * (1 - share), 0])
        return parts.loft(body)

    def _phases(self, y: float) -> tuple[float, float]:
        """How far y lies into the nose and into the tail, each 0 in the cabin and 1 at the end."""
        ahead, behind = (self.nose - 0.5 - y) / self.nose, (y - 0.5 + self.tail) / self.tail
        return min(max(ahead, 0.0), 1.0), min(max(behind, 0.0), 1.0)

    def _ring(self, y: float, segments: int) -> np.ndarray:
        unit = superellipse(segments, self.square)
        x, z = self.half_width(y) * unit[:, 0], self.axis(y) + self.half_height(y) * unit[:, 1]
        return np.column_stack([x, np.full(segments, y), z])


def superellipse(segments: int, power: float) -> np.ndarray:
    """[segments, 2] points of |x|^power + |y|^power = 1, counter-clockwise."""
    unit = parts.circle(segments)
    return np.sign(unit) * np.abs(unit) ** (2 / power)


def lifting_surface(stations, ratio: float, gauge: float, camber: float = 0.0) -> Manifold:
    """A wing, fin or tailplane with a blunt trailing edge of 0.8 `gauge`, the least thickness.

    It runs through stations (leading edge [3], chord, roll of the thickness, 0 for a level wing); `ratio` is
    thickness over chord, `camber` that of the mean line in chords.
    """
    sections = []
    for leading_edge, chord, roll in stations:
        thick = max(ratio * chord, 1.15 * gauge)
        offset = np.maximum(thick * _HALF, 0.4 * gauge * np.minimum(1, 4 * np.sqrt(_ALONG)))
        mean = 4 * camber * chord * _ALONG * (1 - _ALONG)
        y = np.concatenate([_ALONG, _ALONG[:0:-1]]) * chord
        up = np.concatenate([mean + offset, (mean - offset)[:0:-1]])
        across = np.outer(up, [-np.sin(roll), 0, np.cos(roll)])
        sections.append(leading_edge + across + np.outer(y, [0, 1, 0]))
    return parts.loft(sections)


def panel(root, direction, length: float, chords, sweep: float, ratio: float, gauge: float) -> Manifold:
    """A tapered surface with a rounded tip, `length` long from a leading-edge point `root` along a direction
    [2] in x, z; chords are at root and tip, `sweep` is of the leading edge in degrees."""
    roll, back = np.arctan2(direction[1], direction[0]), np.tan(np.radians(sweep))
    stations = []
    for share, trim in ((0, 0), (0.5, 0), (0.94, 0), (1, 0.14)):
        chord = chords[0] + share * (chords[1] - chords[0])
        x, z = np.array([root[0], root[2]]) + share * length * np.asarray(direction)
        y = root[1] + share * length * back + trim * chord
        stations.append(((x, y, z), chord * (1 - 1.4 * trim), roll))
    return lifting_surface(stations, ratio, gauge)


def body_of_revolution(profile, centre, radius: float, length: float = 1.0, segments: int = 18) -> Manifold:
    """A lathe along y around `centre`; `profile` holds (radius, y) from front to rear, in shares."""
    return parts.lathe(profile, segments, radius, length).rotate((-90.0, 0.0, 0.0)).translate(centre)


def jet(radius: float, length: float, centre) -> Manifold:
    """A turbofan nacelle with an open inlet, a spinner inside it and an exhaust cone."""
    spinner = [(0.06, 0.1), (0.2, 0.15), (0.3, 0.28)]
    inlet = [(0.66, 0.28), (0.7, 0.04), (0.78, 0.0), (0.86, 0.0)]
    cowl = [(0.94, 0.03), (1.0, 0.16), (1.0, 0.4), (0.9, 0.7), (0.74, 0.86), (0.44, 0.87)]
    cone = [(0.36, 0.98), (0.16, 1.12)]
    return body_of_revolution(spinner + inlet + cowl + cone, centre, radius, length, 20)


def propeller(radius: float, hub: float, blades: int, gauge: float, centre, turn: float) -> list[Manifold]:
    """A pointed spinner with a foot of radius `hub`, and twisted blades, `gauge` thick, in the plane of its
    centre; the first blade stands at `turn` degrees."""
    profile = [(0.12, -1.7), (0.42, -1.5), (0.68, -1.1), (0.88, -0.6), (1.0, 0.0), (1.0, 0.8)]
    made = [body_of_revolution(profile, centre, hub, hub, 14)]
    chord, sections = max(0.22 * radius, 2.2 * gauge), []
    stations = (0.0, 0.5, 60), (0.3, 0.8, 45), (0.6, 1.0, 28), (0.92, 0.85, 18), (1, 0.5, 16)
    for share, width, twist in stations:
        ring = superellipse(10, 2.5) * [width * chord / 2, gauge / 2]
        c, s = np.cos(np.radians(twist)), np.sin(np.radians(twist))
        sections.append(parts.level(ring @ np.array([[c, s], [-s, c]]), share * radius))
    blade = parts.loft(sections)
    turns = [turn + 360.0 * k / blades for k in range(blades)]
    return made + [blade.rotate((0.0, angle, 0.0)).translate(centre) for angle in turns]


def wheel(radius: float, width: float, centre) -> Manifold:
    """A tyre with rounded shoulders, its axle along x."""
    r, w = radius, width / 2
    profile = [(0.55 * r, -w), (0.84 * r, -w), (r, -0.5 * w), (r, 0.5 * w), (0.84 * r, w), (0.55 * r, w)]
    return parts.lathe(profile, 16).rotate((0.0, 90.0, 0.0)).translate(centre)


def canopy(body, front: float, back: float, peak: float, foot: float, half_width: float, height: float):
    """A bubble on a body from `foot` half heights above its axis: a fighter's canopy, a light aircraft's
    cabin. It is highest, and `half_width` wide to either side, at the share `peak` of its length."""
    unit, sections = superellipse(16, 2.4), []
    for t in (1 - np.cos(np.linspace(0.12, np.pi - 0.12, 11))) / 2:
        side = (peak - t) / peak if t < peak else (t - peak) / (1 - peak)
        rise, y = (1 - side**2) ** 0.62, front + t * (back - front)
        wide = half_width * (0.3 + 0.7 * rise)
        base = body.axis(y) + foot * body.half_height(y)
        z = base + np.where(unit[:, 1] > 0, height * rise, 0.35 * wide) * unit[:, 1]
        sections.append(np.column_stack([wide * unit[:, 0], np.full(len(unit), y), z]))
    return parts.loft(sections)
