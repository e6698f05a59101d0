"""Lamps: floor, table, desk, arc and tripod lamps and pendants, as one parametric design."""

from itertools import pairwise
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
from manifold3d import Manifold

from sdfhub.procedural import lamp_shades, parts

_HEIGHT = {"floor": 1.5, "table": 0.56, "desk": 0.52, "arc": 1.8, "tripod": 1.45, "pendant": 0.8}
_SHADE = {"floor": 0.3, "table": 0.6, "desk": 0.36, "arc": 0.27, "tripod": 0.37, "pendant": 0.58}
_STURDY = {"desk": 1.1, "arc": 1.2}  # where reach makes the lamp large against its height
_BASE = {"floor": 0.22, "table": 0.36, "desk": 0.38, "arc": 0.24, "tripod": 0.3, "pendant": 0.18}


class Lamp(SimpleNamespace):
    """A lamp: a shade with its bulb on a stem that stands on a base or hangs from a canopy."""

    parameters: ClassVar = dict(
        size=(0.85, 1.15), shade_width=(0.8, 1.2), shade_height=(0.55, 0.9), shade_taper=(0.4, 0.8),
        wall=(0.022, 0.03), stem=(0.012, 0.02), base_width=(0.8, 1.2), base_height=(0.03, 0.07),
        belly=(0.35, 0.65), reach=(0.45, 0.75), elbow=(0.4, 0.62), tilt=(0.0, 40.0),
        kind=["floor", "table", "table", "table", "desk", "desk", "arc", "tripod", "pendant", "pendant"],
        shade=["drum", "cone", "cone", "bell", "pleated", "dome", "globe", "bowl"],
        base=["disc", "disc", "cube", "feet", "vase", "gourd", "turned", "bottle"],
        arm=["single", "paired", "bent"], fitting=["spider", "harp", "rings"], finial=[True, False],
        collar=[True, False], lights=[1, 1, 3], pleats=[14, 18, 22],
    )  # fmt: skip

    def build(self) -> Manifold:
        """The lamp as one solid; a standing one stands on z = 0."""
        self._measure()
        kinds = {"desk": self._desk, "arc": self._arc, "tripod": self._tripod, "pendant": self._pendant}
        return parts.union(kinds.get(self.kind, self._upright)())

    def _measure(self) -> None:
        """Sets what several parts share, in metres."""
        several = self.kind == "pendant" and self.lights > 1
        self.tall = _HEIGHT[self.kind] * self.size  # nominal
        # What is thin follows the lamp's size: below 0.015 of the bounding radius it could not be sampled.
        sturdiness = 1.4 if several else _STURDY.get(self.kind, 1.0)
        self.gauge = self.stem * 0.55 * self.tall * sturdiness  # radius of the stem
        self.shade_wall = self.wall * 0.56 * self.tall * sturdiness
        self.diameter = (0.62 if several else 1.0) * _SHADE[self.kind] * self.shade_width * self.tall
        share = {"dome": 0.72, "globe": 1.3, "bowl": 0.5, "drum": 0.9}.get(self.shade, 1.0)
        most = 0.96 if self.shade == "globe" else 2.0
        self.shade_tall = min(share * self.shade_height, most) * self.diameter
        above = 0.55 * self.diameter if self.shade == "bowl" else 0.0
        self.head_top = self.shade_tall + above + 2 * self.gauge  # where a hung head ends, from its lower rim
        self.foot = _BASE[self.kind] * self.base_width * self.tall / 2

    def _upright(self) -> list[Manifold]:
        """A floor or table lamp: base, body, stem and a shade on top."""
        low, g = self.tall - self.shade_tall, self.gauge
        made = [lamp_shades.head(self, hung=False).translate((0, 0, low))]
        is_flat = self.base in ("disc", "cube", "feet")
        made += self._plinth() if is_flat else [self._body(0.93 * low if self.kind == "table" else 0.4 * low)]
        made.append(parts.rod(0.4 * self.base_height if is_flat else 0.02, low, 1.25 * g, 16))
        if self.collar:
            made.append(parts.ellipsoid((2.4 * g, 2.4 * g, 1.6 * g), (0, 0, 0.93 * low), 18))
        return made

    def _plinth(self) -> list[Manifold]:
        """A flat base: a disc, a block or three bent feet."""
        r, h, g = self.foot, self.base_height * min(self.tall, 1.0), self.gauge
        if self.base == "cube" and self.kind in ("desk", "arc"):  # heavier, since they reach out
            h = self.base_height * self.tall
            return [parts.rounded_box((1.6 * r, 1.6 * r, 1.6 * h), (0, 0, 0.8 * h), 0.12 * h)]
        if self.base == "cube":
            return [parts.rounded_box((1.7 * r, 1.7 * r, 1.5 * h), (0, 0, 0.75 * h), 0.1 * h)]
        if self.base == "feet" and self.kind != "arc":
            made, t = [parts.rod(0.5 * r, 0.9 * r, 2.2 * g, 16)], np.linspace(0, 1, 9)[:, None]
            for way in parts.spokes(3):
                start, end = 0.8 * r * np.array([0, 0, 1]), 1.25 * r * way + [0, 0, 1.3 * g]
                path = (1 - t) * start + t * end + 4 * t * (1 - t) * (0.22 * r * (way + [0, 0, 1]))
                made.append(parts.tube(path, 1.25 * g, up=(-way[1], way[0], 0.0)))
                made.append(parts.ellipsoid((1.9 * g, 1.9 * g, 1.5 * g), path[-1] + [0, 0, 0.2 * g], 14))
            return made
        crown = [(0.96 * r, 1.1 * h)]
        if self.collar:
            crown = [(0.55 * r, 1.25 * h), (2.2 * g, 1.45 * h), (1.4 * g, 2.2 * h)]
        return [parts.lathe([(r, 0), (r, 0.7 * h), (0.98 * r, 0.9 * h), *crown], 40)]

    def _body(self, top: float) -> Manifold:
        """A turned or thrown body from the floor to `top`, with an S-curve between each two keys."""
        r, neck, b = self.foot * (0.8 if self.kind == "floor" else 1.0), 2 * self.gauge, self.belly
        turned = [(r, 0), (r, 0.06), (0.5 * r, 0.1), (0.34 * r, 0.16), (0.62 * r, 0.2), (0.34 * r, 0.24)]
        turned += [(0.58 * r, 0.2 + 0.5 * b), (0.3 * r, 0.74), (0.55 * r, 0.79), (0.28 * r, 0.84)]
        keys = {
            "vase": [(0.62 * r, 0), (0.5 * r, 0.06), (r, b), (0.42 * r, 0.86), (0.55 * r, 0.95), (neck, 1)],
            "gourd": [(0.7 * r, 0), (r, 0.5 * b + 0.05), (0.42 * r, 0.62), (0.62 * r, 0.8), (neck, 1)],
            "bottle": [(0.8 * r, 0), (0.95 * r, 0.04), (0.95 * r, b), (neck * 1.2, b + 0.2), (neck, 1)],
            "turned": [*turned, (0.4 * r, 0.92), (neck, 1)],
        }[self.base]
        profile, t = keys[:1], np.linspace(0, 1, 6)[1:]
        for (r0, h0), (r1, h1) in pairwise(keys):
            profile += zip(r0 + (r1 - r0) * t * t * (3 - 2 * t), h0 + (h1 - h0) * t, strict=True)
        return parts.lathe([(radius, top * h) for radius, h in profile], 32)

    def _desk(self) -> list[Manifold]:
        """Two jointed arms, or one bent tube, with a tilted shade at the end."""
        tall, g, foot = self.tall, self.gauge, self.foot
        rear = 0.0 if self.base == "feet" else 0.5 * foot  # feet carry it at their hub
        start = np.array([0, rear, 0.7 * foot if self.base == "feet" else self.base_height * tall * 0.6])
        bend = np.array([0, rear + 0.3 * self.elbow * tall, (0.3 + 0.6 * self.elbow) * tall])
        end = np.array([0, -self.reach * 0.8 * tall, 0.86 * tall])
        made = self._plinth()
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

    def _hung_head(self, end: np.ndarray, tilt: float) -> Manifold:
        """The head turned by `tilt` degrees about the end of an arm, where its rod enters."""
        made = lamp_shades.head(self, hung=True).translate((0, 0, -self.head_top))
        knuckle = parts.ellipsoid((2.3 * self.gauge,) * 3, (0, 0, 0), 16)
        return parts.union([made, knuckle]).rotate((-tilt, 0, 0)).translate(tuple(end))

    def _arc(self) -> list[Manifold]:
        """A heavy base and a bow that carries the shade far out."""
        tall, g, out = self.tall, self.gauge, self.reach * self.tall
        t = np.linspace(0, 1, 22)
        drop = 0.1 + 0.16 * self.elbow
        rise = np.sin(0.5 * np.pi * t / (1 - drop))
        path = np.column_stack([0 * t, 0.42 * out - 1.25 * out * t**1.7, 0.02 + (0.97 * tall) * rise])
        made = [base.translate((0, 0.42 * out, 0)) for base in self._plinth()]
        return [*made, parts.tube(path, 1.25 * g, up=(1, 0, 0)), self._hung_head(path[-1], 0.4 * self.tilt)]

    def _tripod(self) -> list[Manifold]:
        """Three splayed legs that meet in a hub under the shade."""
        tall, g = self.tall, self.gauge
        low = tall - self.shade_tall
        hub, spread = 0.93 * low, 0.2 * tall * self.base_width * (0.7 + 0.5 * self.reach)
        collar = [(3.4 * g, hub - 0.03), (3.4 * g, hub + 0.02), (1.3 * g, hub + 0.04), (1.3 * g, low)]
        made = [lamp_shades.head(self, hung=False).translate((0, 0, low)), parts.lathe(collar)]
        thick, ways = 1.5 * g, parts.spokes(3)
        made += [parts.bar(1.2 * g * w + [0, 0, hub], spread * w, 1.25 * thick, 0.75 * thick) for w in ways]
        if self.arm != "single":
            rung = [spread * w * (1 - self.elbow) + [0, 0, self.elbow * hub] for w in ways]
            centre = [np.array([0, 0, self.elbow * hub])] * 3
            hubs = [rung[1], rung[2], rung[0]] if self.arm == "paired" else centre
            made += [parts.bar(a, b, 0.9 * g) for a, b in zip(rung, hubs, strict=True)]
        return made

    def _pendant(self) -> list[Manifold]:
        """A canopy under the ceiling, a thin rod and a hung shade; or three in a row."""
        tall, g, r = self.tall, self.gauge, self.foot
        hung, end = lamp_shades.head(self, hung=True), self.head_top
        canopy = [(1.4 * g, tall - 0.05), (0.9 * r, tall - 0.035), (r, tall - 0.02), (r, tall)]
        if self.lights == 1:
            return [hung, parts.lathe(canopy, 32), parts.rod(end - 3 * g, tall - 0.01, g, 16)]
        step = 1.25 * self.diameter
        made = [parts.rounded_box((2.3 * step, 0.8 * r, 0.03), (0, 0, tall - 0.015), 0.008)]
        for place, lift in zip((-step, 0, step), (0, 0.2 * (self.elbow - 0.4) * tall, 0), strict=True):
            made.append(hung.translate((place, 0, 2 * lift)))
            made.append(parts.rod(end + 2 * lift - 3 * g, tall - 0.01, g, 16).translate((place, 0, 0)))
        return made
