"""Lamps: floor, table, desk, arc and tripod lamps and pendants, as one parametric design."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from manifold3d import Manifold

from sdfhub.procedural import lamp_shades, parts
from sdfhub.procedural.parameters import choice, continuous

_HEIGHT = {"floor": 1.5, "table": 0.56, "desk": 0.52, "arc": 1.8, "tripod": 1.45, "pendant": 0.8}
_SHADE = {"floor": 0.3, "table": 0.6, "desk": 0.36, "arc": 0.27, "tripod": 0.37, "pendant": 0.58}
_STURDY = {"desk": 1.1, "arc": 1.2}  # where reach makes the lamp large against its height
_BASE = {"floor": 0.22, "table": 0.36, "desk": 0.38, "arc": 0.24, "tripod": 0.3, "pendant": 0.18}


@dataclass(frozen=True)
class Lamp:
    """A lamp: a shade with its bulb on a stem that stands on a base or hangs from a canopy."""

    size: float = continuous(0.85, 1.15)
    shade_width: float = continuous(0.8, 1.2)
    shade_height: float = continuous(0.55, 0.9)
    shade_taper: float = continuous(0.4, 0.8)
    wall: float = continuous(0.022, 0.03)
    stem: float = continuous(0.012, 0.02)
    base_width: float = continuous(0.8, 1.2)
    base_height: float = continuous(0.03, 0.07)
    belly: float = continuous(0.35, 0.65)
    reach: float = continuous(0.45, 0.75)
    elbow: float = continuous(0.4, 0.62)
    tilt: float = continuous(0.0, 40.0)
    kind: str = choice("floor", *["table"] * 3, "desk", "desk", "arc", "tripod", "pendant", "pendant")
    shade: str = choice("drum", "cone", "cone", "bell", "pleated", "dome", "globe", "bowl")
    base: str = choice("disc", "disc", "cube", "feet", "vase", "gourd", "turned", "bottle")
    arm: str = choice("single", "paired", "bent")
    fitting: str = choice("spider", "harp", "rings")
    finial: bool = choice(True, False)
    collar: bool = choice(True, False)
    lights: int = choice(1, 1, 3)
    pleats: int = choice(14, 18, 22)

    def build(self) -> Manifold:
        """The lamp as one solid; a standing one stands on z = 0."""
        kinds = {"desk": self._desk, "arc": self._arc, "tripod": self._tripod, "pendant": self._pendant}
        return parts.union(kinds.get(self.kind, self._upright)())

    def tall(self) -> float:
        """Nominal height in metres."""
        return _HEIGHT[self.kind] * self.size

    def gauge(self) -> float:
        """Radius of the stem; it follows the lamp's size, so that no wire gets lost."""
        return self.stem * 0.55 * self.tall() * self._sturdiness()

    def wall_thickness(self) -> float:
        """Of the shade."""
        return self.wall * 0.56 * self.tall() * self._sturdiness()

    def shade_diameter(self) -> float:
        """Of the shade at its widest."""
        few = 0.62 if self.kind == "pendant" and self.lights > 1 else 1.0
        return few * _SHADE[self.kind] * self.shade_width * self.tall()

    def _sturdiness(self) -> float:
        """Factor on what is thin: thinner than 0.015 of the bounding radius it could not be sampled."""
        return 1.4 if self.kind == "pendant" and self.lights > 1 else _STURDY.get(self.kind, 1.0)

    def _foot(self) -> float:
        return _BASE[self.kind] * self.base_width * self.tall() / 2

    def _upright(self) -> list[Manifold]:
        """A floor or table lamp: base, body, stem and a shade on top."""
        low, g = self.tall() - lamp_shades.height(self), self.gauge()
        made = [lamp_shades.head(self, hung=False).translate((0, 0, low))]
        if self.base in ("disc", "cube", "feet"):
            made += [*self._plinth(), parts.rod(0.4 * self.base_height, low, 1.25 * g, 16)]
        else:
            made.append(self._body(0.93 * low if self.kind == "table" else 0.4 * low))
            made.append(parts.rod(0.02, low, 1.25 * g, 16))
        if self.collar:
            made.append(parts.ellipsoid((2.4 * g, 2.4 * g, 1.6 * g), (0, 0, 0.93 * low), 18))
        return made

    def _plinth(self) -> list[Manifold]:
        """A flat base: a disc, a block or three bent feet."""
        r, h, g = self._foot(), self.base_height * min(self.tall(), 1.0), self.gauge()
        if self.base == "cube":
            return [parts.rounded_box((1.7 * r, 1.7 * r, 1.5 * h), (0, 0, 0.75 * h), 0.1 * h)]
        if self.base == "feet" and self.kind != "arc":
            made = [parts.rod(0.5 * r, 0.9 * r, 2.2 * g, 16)]
            for way in parts.spokes(3):
                start, end = 0.8 * r * np.array([0, 0, 1]), 1.25 * r * way + [0, 0, 1.3 * g]
                path = parts.arc(start, end, 0.22 * r * (way + [0, 0, 1]))
                made.append(parts.tube(path, 1.25 * g, up=(-way[1], way[0], 0.0)))
                made.append(parts.ellipsoid((1.9 * g, 1.9 * g, 1.5 * g), path[-1] + [0, 0, 0.2 * g], 14))
            return made
        crown = [(0.96 * r, 1.1 * h)]
        if self.collar:
            crown = [(0.55 * r, 1.25 * h), (2.2 * g, 1.45 * h), (1.4 * g, 2.2 * h)]
        return [parts.lathe([(r, 0), (r, 0.7 * h), (0.98 * r, 0.9 * h), *crown], 40)]

    def _body(self, top: float) -> Manifold:
        """A turned or thrown body from the floor to `top`."""
        r, g, b = self._foot(), self.gauge(), self.belly
        if self.kind == "floor":
            r *= 0.8
        neck = 2 * g
        turned = [(r, 0), (r, 0.06), (0.5 * r, 0.1), (0.34 * r, 0.16), (0.62 * r, 0.2), (0.34 * r, 0.24)]
        turned += [(0.58 * r, 0.2 + 0.5 * b), (0.3 * r, 0.74), (0.55 * r, 0.79), (0.28 * r, 0.84)]
        keys = {
            "vase": [(0.62 * r, 0), (0.5 * r, 0.06), (r, b), (0.42 * r, 0.86), (0.55 * r, 0.95), (neck, 1)],
            "gourd": [(0.7 * r, 0), (r, 0.5 * b + 0.05), (0.42 * r, 0.62), (0.62 * r, 0.8), (neck, 1)],
            "bottle": [(0.8 * r, 0), (0.95 * r, 0.04), (0.95 * r, b), (neck * 1.2, b + 0.2), (neck, 1)],
            "turned": [*turned, (0.4 * r, 0.92), (neck, 1)],
        }[self.base]
        return parts.lathe([(rr, top * h) for rr, h in _smooth(keys)], 32)

    def _desk(self) -> list[Manifold]:
        """Two jointed arms, or one bent tube, with a tilted shade at the end."""
        tall, g, foot = self.tall(), self.gauge(), self._foot()
        rear = 0.0 if self.base == "feet" else 0.5 * foot  # feet carry it at their hub
        start = np.array([0, rear, 0.7 * foot if self.base == "feet" else self.base_height * tall * 0.6])
        bend = np.array([0, rear + 0.3 * self.elbow * tall, (0.3 + 0.6 * self.elbow) * tall])
        end = np.array([0, -self.reach * 0.8 * tall, 0.86 * tall])
        made = self._plinth_or_block()
        if self.arm == "bent":
            corners = np.array([start, start + [0, 0.02, 0.6 * tall], (0, 0.5 * end[1], 1.12 * tall), end])
            made.append(parts.tube(parts.filleted(corners, 0.16 * tall, 8), 1.2 * g, up=(1, 0, 0)))
        else:
            offsets = (-1.9 * g, 1.9 * g) if self.arm == "paired" else (0.0,)
            for a, b in ((start, bend), (bend, end)):
                made += [parts.bar(a + [x, 0, 0], b + [x, 0, 0], g) for x in offsets]
            for joint, share in ((start, 1.0), (bend, 1.0), (end, 0.9)):
                half = np.array([4.2 * g * share, 0, 0])
                made.append(parts.bar(joint - half, joint + half, 2.2 * g))
        return [*made, self._hung_head(end, 0.6 * self.tilt)]

    def _plinth_or_block(self) -> list[Manifold]:
        """The base of a lamp that reaches out: a heavier block in place of the cube."""
        if self.base != "cube":
            return self._plinth()
        r, h = self._foot(), self.base_height * self.tall()
        return [parts.rounded_box((1.6 * r, 1.6 * r, 1.6 * h), (0, 0, 0.8 * h), 0.12 * h)]

    def _hung_head(self, end: np.ndarray, tilt: float) -> Manifold:
        """The head turned by `tilt` degrees about the end of an arm, where its rod enters."""
        made = lamp_shades.head(self, hung=True).translate((0, 0, -lamp_shades.top(self)))
        knuckle = parts.ellipsoid((2.3 * self.gauge(),) * 3, (0, 0, 0), 16)
        return parts.union([made, knuckle]).rotate((-tilt, 0, 0)).translate(tuple(end))

    def _arc(self) -> list[Manifold]:
        """A heavy base and a bow that carries the shade far out."""
        tall, g = self.tall(), self.gauge()
        out = self.reach * tall
        t = np.linspace(0, 1, 22)
        drop = 0.1 + 0.16 * self.elbow
        rise = np.sin(0.5 * np.pi * t / (1 - drop))
        path = np.column_stack([0 * t, 0.42 * out - 1.25 * out * t**1.7, 0.02 + (0.97 * tall) * rise])
        made = [base.translate((0, 0.42 * out, 0)) for base in self._plinth_or_block()]
        made.append(parts.tube(path, 1.25 * g, up=(1, 0, 0)))
        return [*made, self._hung_head(path[-1], 0.4 * self.tilt)]

    def _tripod(self) -> list[Manifold]:
        """Three splayed legs that meet in a hub under the shade."""
        tall, g = self.tall(), self.gauge()
        low = tall - lamp_shades.height(self)
        hub, spread = 0.93 * low, 0.2 * tall * self.base_width * (0.7 + 0.5 * self.reach)
        collar = [(3.4 * g, hub - 0.03), (3.4 * g, hub + 0.02), (1.3 * g, hub + 0.04), (1.3 * g, low)]
        made = [lamp_shades.head(self, hung=False).translate((0, 0, low)), parts.lathe(collar)]
        thick, feet = 1.5 * g, [spread * way for way in parts.spokes(3)]
        for way, foot in zip(parts.spokes(3), feet, strict=True):
            made.append(parts.bar(1.2 * g * way + [0, 0, hub], foot, 1.25 * thick, 0.75 * thick))
        if self.arm != "single":
            rung = [f * (1 - self.elbow) + [0, 0, self.elbow * hub] for f in feet]
            centre = [np.array([0, 0, self.elbow * hub])] * 3
            hubs = [rung[1], rung[2], rung[0]] if self.arm == "paired" else centre
            made += [parts.bar(a, b, 0.9 * g) for a, b in zip(rung, hubs, strict=True)]
        return made

    def _pendant(self) -> list[Manifold]:
        """A canopy under the ceiling, a thin rod and a hung shade; or three in a row."""
        tall, g, r = self.tall(), self.gauge(), self._foot()
        hung = lamp_shades.head(self, hung=True)
        end = lamp_shades.top(self)
        canopy = [(1.4 * g, tall - 0.05), (0.9 * r, tall - 0.035), (r, tall - 0.02), (r, tall)]
        if self.lights == 1:
            return [hung, parts.lathe(canopy, 32), parts.rod(end - 3 * g, tall - 0.01, g, 16)]
        step = 1.25 * self.shade_diameter()
        rail = parts.rounded_box((2.3 * step, 0.8 * r, 0.03), (0, 0, tall - 0.015), 0.008)
        made = [rail]
        for place, lift in zip((-step, 0, step), (0, 0.2 * (self.elbow - 0.4) * tall, 0), strict=True):
            made.append(hung.translate((place, 0, 2 * lift)))
            made.append(parts.rod(end + 2 * lift - 3 * g, tall - 0.01, g, 16).translate((place, 0, 0)))
        return made


def _smooth(keys: list[tuple[float, float]], steps: int = 5) -> list[tuple[float, float]]:
    """(radius, height) pairs with an S-curve between each two."""
    profile = [keys[0]]
    for (r0, h0), (r1, h1) in pairwise(keys):
        t = np.linspace(0, 1, steps + 1)[1:]
        profile += list(zip(r0 + (r1 - r0) * t * t * (3 - 2 * t), h0 + (h1 - h0) * t, strict=True))
    return profile
