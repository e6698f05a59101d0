"""Tables: dining, coffee, farmhouse, trestle, pedestal, hairpin and slab, from one set of parameters."""

from dataclasses import dataclass

import numpy as np
from manifold3d import Manifold

from sdfhub.procedural import parts
from sdfhub.procedural.parameters import choice, continuous


@dataclass(frozen=True)
class Table:
    """One table. Lengths in metres; its length runs along x."""

    height: float = continuous(0.42, 0.80)
    length: float = continuous(0.80, 1.45)
    depth: float = continuous(0.52, 0.85)
    top_thickness: float = continuous(0.026, 0.055)
    edge_round: float = continuous(0.0, 0.48)
    overhang: float = continuous(0.02, 0.12)
    leg_width: float = continuous(0.042, 0.085)
    leg_taper: float = continuous(0.45, 0.95)
    leg_splay: float = continuous(0.0, 0.10)
    apron_height: float = continuous(0.05, 0.12)
    stretcher_height: float = continuous(0.16, 0.34)
    foot_reach: float = continuous(0.55, 0.8)
    top: str = choice("rectangle", "rectangle", "rounded", "boat", "oval", "round")
    base: str = choice(
        "square", "square", "turned", "round", "hairpin", "trestle", "cross", "pedestal", "slab", "loop"
    )
    stretchers: str = choice("none", "none", "h", "box", "shelf")
    apron: bool = choice(True, False)
    drawers: int = choice(0, 0, 1, 2, 3)
    feet: int = choice(3, 4, 5)

    def build(self) -> Manifold:
        """The table as one solid, standing on z = 0."""
        bases = {"trestle": self._trestle, "cross": self._cross, "pedestal": self._pedestal}
        bases |= {"slab": self._slab, "loop": self._loop}
        return parts.union([self._top(), *bases.get(self.base, self._four_legs)()])

    def _size(self) -> np.ndarray:
        """Length and depth of the top; a round one has only one."""
        if self.top == "round":
            return np.full(2, 0.5 * (self.length + self.depth))
        return np.array([self.length, self.depth])

    def _under(self) -> float:
        """A height within the top where what carries it ends."""
        return self.height - 0.6 * self.top_thickness

    def _outline(self) -> np.ndarray:
        length, depth = self._size()
        if self.top == "rectangle":
            return parts.rounded_rectangle(length, depth, 0.008)
        if self.top == "rounded":
            return parts.rounded_rectangle(length, depth, 0.28 * depth)
        power = {"boat": 0.42, "oval": 0.82, "round": 1.0}[self.top]
        unit = parts.circle(56)
        return np.sign(unit) * np.abs(unit) ** power * [length / 2, depth / 2]

    def _top(self) -> Manifold:
        bottom, radius = self.height - self.top_thickness, self.edge_round * self.top_thickness
        return parts.pad(self._outline(), bottom, self.height, radius)

    def _corner(self) -> np.ndarray:
        """(x, y) of the legs' axes in the quadrant where both are positive, under every kind of top."""
        share = {"rectangle": 1.0, "rounded": 1.0, "boat": 0.84, "oval": 0.74, "round": 0.7}[self.top]
        cut = 0.09 * self._size()[1] if self.top == "rounded" else 0.0  # what its round corners take away
        inset = cut + 0.5 * self.leg_width + 0.5 * self.overhang
        return share * self._size() / 2 - inset - (0.02 if self.base == "hairpin" else 0.0)

    def _ends(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """(top, foot) of the legs: front left, front right, back left, back right."""
        corner, ends = self._corner(), []
        for y in (-1, 1):
            for x in (-1, 1):
                top = np.array([x * corner[0], y * corner[1], self._under()])
                splay = self.leg_splay if self.base in ("round", "hairpin") else 0.12 * self.leg_splay
                ends.append((top, np.array([top[0] + x * splay, top[1] + y * 0.6 * splay, 0.0])))
        return ends

    def _four_legs(self) -> list[Manifold]:
        ends = self._ends()
        made = [part for top, foot in ends for part in self._leg(top, foot)]
        if self.base == "hairpin":
            return made
        if self.base != "round" and (self.apron or self.drawers):
            made += self._aprons([top for top, _ in ends])
        return made + self._stretchers(ends)

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
        r, h = 0.56 * w, self.height
        block = 1 - self.apron_height / h - 0.04
        waist = 0.55 + 0.25 * taper
        knots = [(0.5, 0), (0.72, 0.02), (0.72, 0.06), (0.5, 0.1), (0.55, 0.13), (waist, 0.3), (1.05, 0.72)]
        knots += [(0.95, 0.84), (0.6, 0.88), (0.9, 0.92), (0.9, 0.96), (0.62, 1.0)]
        turned = parts.turned(foot, foot + (top - foot) * block, parts.scaled(knots, r))
        return [turned, parts.square_bar(foot + (top - foot) * (block - 0.01), top, w)]

    def _aprons(self, tops: list[np.ndarray]) -> list[Manifold]:
        """Boards between the legs; drawer fronts with knobs in the front one."""
        z = self.height - self.top_thickness - self.apron_height / 2 + 0.01
        made = parts.aprons(tops, z, 0.024, self.apron_height + 0.02)
        x, y = self._corner()
        width = 2 * x - self.leg_width
        for k in range(self.drawers):
            centre = width * ((k + 0.5) / self.drawers - 0.5)
            front = (width / self.drawers - 0.04, 0.03, self.apron_height - 0.024)
            made.append(parts.box(front, (centre, -y - 0.012, z - 0.004)))
            made.append(parts.bar((centre, -y, z - 0.004), (centre, -y - 0.052, z - 0.004), 0.012, 0.016))
        return made

    def _stretchers(self, ends: list[tuple[np.ndarray, np.ndarray]]) -> list[Manifold]:
        if self.stretchers == "none":
            return []
        share = 0.7 * self.stretcher_height
        joints = [foot + share * (top - foot) for top, foot in ends]
        if self.stretchers == "shelf":
            shelf = 2 * np.abs(joints[0][:2])
            return [parts.box((*shelf, 0.026), (0, 0, joints[0][2]))]
        pairs = parts.stretchers(joints, self.stretchers)
        if self.base == "square":
            return [parts.plank(a, b, 0.028, 0.04) for a, b in pairs]
        return [parts.turned(a, b, [(0.015, 0), (0.021, 0.5), (0.015, 1)]) for a, b in pairs]

    def _trestle(self) -> list[Manifold]:
        """Two uprights on long feet, tied by a beam."""
        x, y = self._corner() * [0.78, 0.95]
        w, foot, top, made = self.leg_width, 0.07, self._under(), []
        for side in (-x, x):
            made.append(parts.rounded_box((1.15 * w, 2 * y, foot), (side, 0, foot / 2), 0.02))
            made.append(parts.square_bar((side, 0, 0.5 * foot), (side, 0, top), w * (2.4 - self.leg_taper)))
            made.append(parts.rounded_box((1.1 * w, 1.7 * y, 0.06), (side, 0, top - 0.02), 0.015))
        z = self.height * (0.2 + self.stretcher_height)
        made.append(parts.plank((-x - 0.08, 0, z), (x + 0.08, 0, z), 0.034, 0.075))
        return made

    def _cross(self) -> list[Manifold]:
        """Two X-shaped frames, tied where their bars cross."""
        x, y = self._corner() * [0.86, 1.0]
        thick, top, made = 0.6 * self.leg_width, self._under(), []
        for side in (-x, x):
            for tilt in (-1, 1):
                made.append(parts.square_bar((side, -tilt * y, 0.0), (side, tilt * y * 0.92, top), thick))
            made.append(parts.plank((side, -y, top - 0.02), (side, y, top - 0.02), thick, 0.05))
        z = top / 1.92
        made.append(parts.bar((-x, 0, z), (x, 0, z), 0.4 * thick + 0.006))
        return made

    def _pedestal(self) -> list[Manifold]:
        """A turned column on curved feet; a long table stands on two."""
        length, depth = self._size()
        column = parts.union(self._column(self.foot_reach * depth / 2 + 0.08))
        if length < 1.45 * depth:
            return [column]
        x, z = 0.25 * length, self._under() - 0.03
        beam = parts.plank((-x, 0, z), (x, 0, z), 0.05, 0.06)
        return [column.translate((-x, 0.0, 0.0)), column.translate((x, 0.0, 0.0)), beam]

    def _column(self, reach: float) -> list[Manifold]:
        r, z, low = 0.85 * self.leg_width, self._under(), 0.14 * self.height
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
        x, y = self._corner() * [0.96, 0.96]
        thick = 0.5 * self.leg_width + 0.012
        made = []
        for side in (-1, 1):
            foot, top = side * (x - 0.6 * self.leg_splay), side * x
            ring = parts.rounded_rectangle(thick, 2 * y, 0.006)
            ends = ((foot, 0.0), (top, self._under()))
            rings = [np.column_stack([ring + [c, 0], np.full(len(ring), level)]) for c, level in ends]
            made.append(parts.loft(np.array(rings)))
        z = self.height - self.top_thickness - self.apron_height / 2 + 0.01
        made.append(parts.plank((-x, 0, z), (x, 0, z), 0.03, self.apron_height + 0.02))
        if self.stretchers == "shelf":
            level = self.stretcher_height * self.height
            made.append(parts.box((2 * x - self.leg_splay, 1.8 * y, 0.026), (0, 0, level)))
        return made

    def _loop(self) -> list[Manifold]:
        """A steel frame of flat bar on each side."""
        x, y = self._corner()
        made, section = [], parts.rounded_rectangle(0.026, 0.8 * self.leg_width + 0.016, 0.005)
        lean = 0.8 * self.leg_splay
        for side in (-1, 1):
            top, low = self._under() - 0.013, 0.013
            corners = [(side * x, 0, top), (side * x, y, top), (side * (x + lean * 0.4), y + lean, low)]
            corners += [(side * (x + lean * 0.4), -y - lean, low), (side * x, -y, top), (side * x, 0.01, top)]
            made.append(parts.sweep(parts.filleted(corners, 0.03, 3), section, up=(1, 0, 0)))
        made.append(parts.plank((-x, 0, self._under() - 0.02), (x, 0, self._under() - 0.02), 0.04, 0.045))
        return made
