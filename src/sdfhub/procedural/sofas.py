"""Sofas: track, rolled, winged, Chesterfield, camelback, modular and chaise, from one set of parameters."""

from types import SimpleNamespace
from typing import ClassVar

import numpy as np
from manifold3d import CrossSection, Manifold

from sdfhub.procedural import parts, sofa_upholstery


class Sofa(SimpleNamespace):
    """One sofa. Lengths in metres; arms, back, cushions and legs combine freely."""

    parameters: ClassVar = dict(
        seat_width=(0.54, 0.74), seat_depth=(0.58, 0.72), seat_height=(0.4, 0.48),
        cushion_height=(0.11, 0.18), cushion_radius=(0.025, 0.055), crown=(0.0, 0.04), gap=(0.012, 0.03),
        back_height=(0.3, 0.5), back_thickness=(0.13, 0.2), back_lean=(0.03, 0.14), hump=(0.07, 0.16),
        channel_width=(0.12, 0.22), arm_width=(0.1, 0.22), arm_height=(0.13, 0.26), arm_slope=(0.3, 0.8),
        leg_height=(0.07, 0.16), leg_width=(0.036, 0.06), leg_splay=(0.0, 0.05), chaise_length=(0.45, 0.8),
        pillow_size=(0.34, 0.44), seats=[1, 2, 2, 3, 3, 4],
        arms=["track", "square", "rolled", "rolled", "sloped", "wing", "none"],
        back=["tight", "cushions", "cushions", "channels", "camel", "tufted", "chesterfield"],
        seat=["separate", "separate", "separate", "bench"],
        legs=["block", "tapered", "tapered", "turned", "sled", "plinth"],
        chaise=["none", "none", "none", "none", "left", "right"],
        pillows=["none", "none", "one", "two", "bolsters"],
    )  # fmt: skip

    def build(self) -> Manifold:
        """The sofa as one solid, standing on z = 0."""
        self._measure()
        rear = self.rear - (0.5 * self.wall if self.back == "chesterfield" else 0.012)
        frame = self._boxes(self.half_seat, rear, self.leg_height, 0.014, 0.0)
        made = [*frame, *self._arms(), *self._legs(), *sofa_upholstery.back(self)]
        return parts.union([*made, *sofa_upholstery.seats(self), *sofa_upholstery.loose(self)])

    def _measure(self) -> None:
        """Sets what several parts share."""
        # A Chesterfield's back, a wall of its own thickness with round corners, runs on as its arms.
        chesterfield = self.back == "chesterfield"
        self.wall, self.bend = 0.8 * self.arm_width, 0.14 + 0.5 * self.hump
        self.armless = self.arms == "none" and not chesterfield
        # Half the width between and over the arms, and of the back; four seats are narrower ones.
        self.half_seat = 0.5 * self.seats * self.seat_width * (0.88 if self.seats == 4 else 1.0)
        self.half_width = self.half_seat + (0.0 if self.armless else self.arm_width)
        self.half_back = self.half_seat + (0.0 if self.armless else 0.72 * self.arm_width)
        # y of the seat's front edge, of the frame's back, of the back's front where it meets the seat.
        self.front, self.rear = -self.seat_depth / 2, self.seat_depth / 2 + self.back_thickness
        self.back_face = self.rear - self.wall if chesterfield else self.seat_depth / 2
        self.deck = self.seat_height - self.cushion_height  # z of the board that carries the cushions
        # The chaise's ends in x, None without one, and its front edge.
        width = min(max(2 * self.half_seat / self.seats, 0.58), 2 * self.half_seat)
        left, right = self.half_seat - width, self.half_seat
        self.chaise_span = {"right": (left, right), "left": (-right, -left)}.get(self.chaise)
        self.chaise_front = self.front - self.chaise_length

    def _boxes(self, x: float, rear: float, low: float, setback: float, inset: float) -> list[Manifold]:
        """Boxes from `low` to the deck below the seat and the chaise, smaller by `inset` on all sides."""
        plans = [(-x, x, self.front, rear)]
        if self.chaise_span:
            plans.append((*self.chaise_span, self.chaise_front, self.front + 0.2))
        made = []
        for left, right, edge, back in plans:
            front = edge + setback
            size = (right - left - 2 * inset, back - front - 2 * inset, self.deck - low)
            centre = ((left + right) / 2, (front + back) / 2, (self.deck + low) / 2)
            made.append(parts.rounded_box(size, centre, 0.012))
        return made

    def _arms(self) -> list[Manifold]:
        if self.armless or self.back == "chesterfield":
            return []
        low, top = self.leg_height, self.seat_height + self.arm_height
        size = np.array([self.arm_width, self.rear - self.front - 0.03, top - low])
        middle = np.array([self.half_seat + self.arm_width / 2, self.back_thickness / 2, (low + top) / 2])
        if self.arms == "track":
            return parts.mirrored(parts.rounded_box(size, middle, 0.9 * self.cushion_radius, 4))
        if self.arms == "square":
            return parts.mirrored(parts.box(size, middle))
        if self.arms == "sloped":
            return parts.mirrored(self._sloped_arm(low))
        if self.arms == "wing":
            return parts.mirrored(parts.union([self._rolled_arm(), self._wing()]))
        return parts.mirrored(self._rolled_arm())

    def _sloped_arm(self, low: float) -> Manifold:
        """An arm whose top falls from the back to the front."""
        high = self.seat_height + self.arm_height + (self.back_height - self.arm_height) * self.arm_slope
        ends, low_front = [], self.seat_height + 0.5 * self.arm_height
        for y, top in ((self.front + 0.06, low_front), (self.rear - 0.06, high)):
            centre = (self.half_seat + self.arm_width / 2, y, (low + top) / 2)
            ends.append(parts.rounded_box((self.arm_width, 0.1, top - low), centre, 0.03, 4))
        return Manifold.batch_hull(ends)

    def _rolled_arm(self) -> Manifold:
        """An upright with a roll of stuffing along its top that hangs over on the outside."""
        radius = 0.45 * self.arm_width + 0.022
        top = self.seat_height + self.arm_height - radius
        roll = CrossSection.circle(radius, 32).translate((self.half_seat + radius - 0.012, top))
        upright = CrossSection.square((0.84 * self.arm_width, top - self.leg_height))
        upright = upright.translate((self.half_seat - 0.002, self.leg_height))
        arm = Manifold.extrude(roll + upright, self.rear - self.front - 0.03)
        return arm.rotate((90, 0, 0)).translate((0, self.rear - 0.012, 0))

    def _wing(self) -> Manifold:
        """A side panel that shelters the head, in the plane of y and z."""
        rise, base, front = self.back_height, self.seat_height, 0.12 * self.seat_depth
        corners = [(self.rear - 0.02, base - 0.1, 0), (0.02 * self.seat_depth, base - 0.1, 0)]
        corners += [(front, base + 0.7 * self.arm_height, 0), (front, base + 0.97 * rise, 0)]
        corners.append((self.rear + self.back_lean - 0.04, base + 0.99 * rise, 0))
        corners.append((self.rear + 0.5 * self.back_lean - 0.03, base + 0.4 * rise, 0))
        curve = parts.filleted(corners, 0.07)[::-1, :2]
        panel = Manifold.extrude(CrossSection([curve]), 0.055 + 0.1 * self.arm_width)
        turned = panel.transform(np.array([[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0]], float))
        return turned.translate((self.half_seat - 0.004, 0, 0))

    def _legs(self) -> list[Manifold]:
        chesterfield = self.back == "chesterfield"
        if self.legs == "sled":
            return self._sled()
        if self.legs == "plinth":
            x = self.half_seat + 0.02 if chesterfield else self.half_width
            return self._boxes(x, self.rear - (0.5 * self.wall if chesterfield else 0.0), 0.0, 0.0, 0.045)
        x = self.half_seat + self.wall if chesterfield else self.half_width
        tuck = 0.3 * self.bend if chesterfield else 0.0
        sides = (-1, 1) if self.half_width < 0.95 else (-1, 0, 1)
        corners = [(side * x, self.front, side) for side in sides]
        corners += [(side * (x - tuck), self.rear - abs(side) * tuck, side) for side in sides]
        if self.chaise_span:
            left, right = self.chaise_span
            corners += [(left, self.chaise_front, -1), (right, self.chaise_front, 1)]
        return [self._leg(*corner) for corner in corners]

    def _leg(self, x: float, y: float, side: int) -> Manifold:
        """A leg near the outer corner (x, y) of what it carries; `side` is the corner's, -1, 0 or 1."""
        w, z = self.leg_width, self.leg_height + 0.025
        outwards = np.array([side, 1.0 if y > 0 else -1.0])
        axis = np.array([x, y]) - (0.05 + 0.5 * w) * outwards
        top, below = np.array([*axis, z]), np.array([*axis, 0.0])
        if self.legs == "block":
            return parts.square_bar(below, top, 1.25 * w, 1.5 * w)
        if self.legs == "tapered":
            return parts.bar((*(axis + self.leg_splay * outwards), 0.0), top, 0.45 * w, 0.75 * w)
        bun = [(0.5, 0), (0.62, 0.06), (0.95, 0.25), (1.05, 0.42), (0.9, 0.58), (0.55, 0.66)]
        bun += [(0.75, 0.7), (0.75, 0.76), (0.9, 0.8), (0.9, 1.0)]
        return parts.turned(below, top, bun, w)

    def _sled(self) -> list[Manifold]:
        """Loops of bent tube that run from front to back."""
        r, x, out = 0.42 * self.leg_width, self.half_width - 0.09, 0.5 * self.leg_splay
        loops = [(c, self.front) for c in ([-x, x] if x < 0.95 else [-x, 0.0, x])]
        if self.chaise_span:
            left, right = self.chaise_span
            loops += [(left + 0.09, self.chaise_front), (right - 0.09, self.chaise_front)]
        made = []
        for c, front in loops:
            top, near, far = self.leg_height + 0.03, front + 0.07, self.rear - 0.08
            corners = [(c, near, top), (c, near - out, r), (c, far + out, r), (c, far, top)]
            made.append(parts.tube(parts.filleted(corners, 0.04), r, up=(1, 0, 0)))
        return made
