"""Tables: dining, coffee, farmhouse, trestle, pedestal, hairpin and slab, from one set of parameters."""

from types import SimpleNamespace
from typing import ClassVar

import numpy as np
from manifold3d import Manifold

from sdfhub.procedural import parts


class Table(SimpleNamespace):
    """One table. Lengths in metres; its length runs along x."""

    parameters: ClassVar = dict(
        height=(0.42, 0.8), length=(0.8, 1.45), depth=(0.52, 0.85), top_thickness=(0.026, 0.055),
        edge_round=(0.0, 0.48), overhang=(0.02, 0.12), leg_width=(0.042, 0.085), leg_taper=(0.45, 0.95),
        leg_splay=(0.0, 0.1), apron_height=(0.05, 0.12), stretcher_height=(0.16, 0.34),
        foot_reach=(0.55, 0.8), top=["rectangle", "rectangle", "rounded", "boat", "oval", "round"],
        base=["square", "square", "turned", "round", "hairpin", "trestle", "cross", "pedestal", "slab",
              "loop"],
        stretchers=["none", "none", "h", "box", "shelf"], apron=[True, False], drawers=[0, 0, 1, 2, 3],
        feet=[3, 4, 5],
    )  # fmt: skip

    def build(self) -> Manifold:
        """The table as one solid, standing on z = 0."""
        self._measure()
        bases = dict(trestle=self._trestle, cross=self._cross, pedestal=self._pedestal)
        bases |= dict(slab=self._slab, loop=self._loop)
        return parts.union([self._top(), *bases.get(self.base, self._four_legs)()])

    def _measure(self) -> None:
        """Sets what several parts share."""
        length, depth, thick = self.length, self.depth, self.top_thickness
        self.extent = np.array([length, depth]) if self.top != "round" else np.full(2, 0.5 * (length + depth))
        # z within the top where what carries it ends; z of the boards below it.
        self.under, self.rail = self.height - 0.6 * thick, self.height - thick - self.apron_height / 2 + 0.01
        # (x, y) of the legs' axes in the quadrant where both are positive, under every kind of top.
        share = {"rectangle": 1.0, "rounded": 1.0, "boat": 0.84, "oval": 0.74, "round": 0.7}[self.top]
        cut = 0.09 * self.extent[1] if self.top == "rounded" else 0.0  # what its round corners take away
        inset = cut + 0.5 * self.leg_width + 0.5 * self.overhang
        self.corner = share * self.extent / 2 - inset - (0.02 if self.base == "hairpin" else 0.0)

    def _top(self) -> Manifold:
        length, depth = self.extent
        if self.top in ("rectangle", "rounded"):
            rounding = 0.008 if self.top == "rectangle" else 0.28 * depth
            outline = parts.rounded_rectangle(length, depth, rounding)
        else:
            unit, power = parts.circle(56), {"boat": 0.42, "oval": 0.82, "round": 1.0}[self.top]
            outline = np.sign(unit) * np.abs(unit) ** power * [length / 2, depth / 2]
        bottom, radius = self.height - self.top_thickness, self.edge_round * self.top_thickness
        return parts.pad(outline, bottom, self.height, radius)

    def _four_legs(self) -> list[Manifold]:
        """Legs in the corners, front left first, and the boards, bars or shelf between them."""
        ends = []
        splay = self.leg_splay if self.base in ("round", "hairpin") else 0.12 * self.leg_splay
        for y in (-1, 1):
            for x in (-1, 1):
                top = np.array([x * self.corner[0], y * self.corner[1], self.under])
                ends.append((top, np.array([top[0] + x * splay, top[1] + y * 0.6 * splay, 0.0])))
        made = [part for top, foot in ends for part in self._leg(top, foot)]
        if self.base == "hairpin":
            return made
        if self.base != "round" and (self.apron or self.drawers):
            made += self._aprons(ends)
        share, radii = 0.7 * self.stretcher_height, None if self.base == "square" else (0.015, 0.021)
        return made + parts.stretchers(ends, share, self.stretchers, (0.028, 0.04), radii)

    def _leg(self, top: np.ndarray, foot: np.ndarray) -> list[Manifold]:
        w, taper = self.leg_width, self.leg_taper
        if self.base == "square":
            return [parts.square_bar(foot, top, w * taper, w)]
        if self.base == "round":
            return [parts.bar(foot, top, 0.5 * w * taper, 0.58 * w)]
        if self.base == "hairpin":
            r = 0.0125 + 0.05 * (self.leg_width - 0.042)
            out = np.sign(top[0]) * np.array([0.09, 0, 0])
            tip = np.array([foot[0], foot[1], r])
            bend = [top - out, tip - 0.22 * out, tip + 0.12 * out, top + 0.1 * out]
            plate = parts.box((0.16, 0.07, 0.02), top - 0.45 * out - [0, 0, 0.4 * self.top_thickness])
            return [parts.tube(parts.filleted(bend, 0.02, 4), r, 10, up=(0, 1, 0)), plate]
        block, waist = 1 - self.apron_height / self.height - 0.04, 0.55 + 0.25 * taper
        knots = [(0.5, 0), (0.72, 0.02), (0.72, 0.06), (0.5, 0.1), (0.55, 0.13), (waist, 0.3), (1.05, 0.72)]
        knots += [(0.95, 0.84), (0.6, 0.88), (0.9, 0.92), (0.9, 0.96), (0.62, 1.0)]
        turned = parts.turned(foot, foot + (top - foot) * block, knots, 0.56 * w)
        return [turned, parts.square_bar(foot + (top - foot) * (block - 0.01), top, w)]

    def _aprons(self, ends: list[tuple[np.ndarray, np.ndarray]]) -> list[Manifold]:
        """Boards between the legs; drawer fronts with knobs in the front one."""
        z, (x, y) = self.rail, self.corner
        made = parts.aprons(ends, z, 0.024, self.apron_height + 0.02)
        width = 2 * x - self.leg_width
        for k in range(self.drawers):
            centre = width * ((k + 0.5) / self.drawers - 0.5)
            front = (width / self.drawers - 0.04, 0.03, self.apron_height - 0.024)
            made.append(parts.box(front, (centre, -y - 0.012, z - 0.004)))
            made.append(parts.bar((centre, -y, z - 0.004), (centre, -y - 0.052, z - 0.004), 0.012, 0.016))
        return made

    def _trestle(self) -> list[Manifold]:
        """Two uprights on long feet, tied by a beam."""
        x, y = self.corner * [0.78, 0.95]
        w, foot, top, made = self.leg_width, 0.07, self.under, []
        for side in (-x, x):
            made.append(parts.rounded_box((1.15 * w, 2 * y, foot), (side, 0, foot / 2), 0.02))
            made.append(parts.square_bar((side, 0, 0.5 * foot), (side, 0, top), w * (2.4 - self.leg_taper)))
            made.append(parts.rounded_box((1.1 * w, 1.7 * y, 0.06), (side, 0, top - 0.02), 0.015))
        z = self.height * (0.2 + self.stretcher_height)
        return [*made, parts.plank((-x - 0.08, 0, z), (x + 0.08, 0, z), 0.034, 0.075)]

    def _cross(self) -> list[Manifold]:
        """Two X-shaped frames, tied where their bars cross."""
        x, y = self.corner * [0.86, 1.0]
        thick, top, made = 0.6 * self.leg_width, self.under, []
        for side in (-x, x):
            for tilt in (-1, 1):
                made.append(parts.square_bar((side, -tilt * y, 0.0), (side, tilt * y * 0.92, top), thick))
            made.append(parts.plank((side, -y, top - 0.02), (side, y, top - 0.02), thick, 0.05))
        return [*made, parts.bar((-x, 0, top / 1.92), (x, 0, top / 1.92), 0.4 * thick + 0.006)]

    def _pedestal(self) -> list[Manifold]:
        """A turned column on curved feet; a long table stands on two."""
        length, depth = self.extent
        column = parts.union(self._column(self.foot_reach * depth / 2 + 0.08))
        if length < 1.45 * depth:
            return [column]
        x, z = 0.25 * length, self.under - 0.03
        beam = parts.plank((-x, 0, z), (x, 0, z), 0.05, 0.06)
        return [column.translate((-x, 0.0, 0.0)), column.translate((x, 0.0, 0.0)), beam]

    def _column(self, reach: float) -> list[Manifold]:
        r, z, low = 0.85 * self.leg_width, self.under, 0.14 * self.height
        waist = 0.4 + 0.4 * self.leg_taper
        knots = [(1.0, 0), (1.0, 0.2), (waist, 0.26), (1.25, 0.42), (1.1, 0.52), (waist, 0.7), (waist, 0.8)]
        knots += [(1.0, 0.84), (1.0, 0.88), (1.9, 0.95), (2.6, 0.96), (2.6, 1.0)]
        made = [parts.lathe([(r * a, low + (z - low) * h) for a, h in knots], 28)]
        thick = 0.5 * self.leg_width + 0.008
        drop = [(0.0, 0.22), (0.25, 0.225), (0.5, 0.16), (0.75, 0.07), (1.0, 0.034)]
        for out in parts.spokes(self.feet):
            path = np.array([reach * a * out + [0, 0, h * self.height + 0.01] for a, h in drop])
            made.append(parts.sweep(path, parts.rounded_rectangle(thick, 0.07, 0.012)))
            made.append(parts.ellipsoid((thick, thick, 0.034), reach * out + [0, 0, 0.034], 14))
        return made

    def _slab(self) -> list[Manifold]:
        """Two full panels as sides and a rail below the top."""
        x, y = self.corner * [0.96, 0.96]
        ring, made = parts.rounded_rectangle(0.5 * self.leg_width + 0.012, 2 * y, 0.006), []
        for side in (-1, 1):
            ends = (side * (x - 0.6 * self.leg_splay), 0.0), (side * x, self.under)
            made.append(parts.loft([parts.level(ring + [c, 0], z) for c, z in ends]))
        made.append(parts.plank((-x, 0, self.rail), (x, 0, self.rail), 0.03, self.apron_height + 0.02))
        if self.stretchers == "shelf":
            z = self.stretcher_height * self.height
            made.append(parts.box((2 * x - self.leg_splay, 1.8 * y, 0.026), (0, 0, z)))
        return made

    def _loop(self) -> list[Manifold]:
        """A steel frame of flat bar on each side."""
        (x, y), lean = self.corner, 0.8 * self.leg_splay
        made, section = [], parts.rounded_rectangle(0.026, 0.8 * self.leg_width + 0.016, 0.005)
        top, low, z = self.under - 0.013, 0.013, self.under - 0.02
        for side in (-1, 1):
            corners = [(side * x, 0, top), (side * x, y, top), (side * (x + lean * 0.4), y + lean, low)]
            corners += [(side * (x + lean * 0.4), -y - lean, low), (side * x, -y, top), (side * x, 0.01, top)]
            made.append(parts.sweep(parts.filleted(corners, 0.03, 3), section, up=(1, 0, 0)))
        return [*made, parts.plank((-x, 0, z), (x, 0, z), 0.04, 0.045)]
