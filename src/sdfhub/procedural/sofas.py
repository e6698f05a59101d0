"""Sofas: track, rolled, winged, Chesterfield, camelback, modular and chaise, from one set of parameters."""

from types import SimpleNamespace
from typing import ClassVar

import numpy as np
from manifold3d import CrossSection, Manifold

from sdfhub.procedural import parts, sofa_backs, sofa_cushions


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
        made = [*self._frame(), *self._arms(), *self._legs(), *sofa_backs.back(self)]
        return parts.union([*made, *sofa_cushions.seats(self), *sofa_cushions.loose(self)])

    @property
    def half_seat(self) -> float:
        """Half the width between the arms; four seats are narrower ones."""
        return 0.5 * self.seats * self.seat_width * (0.88 if self.seats == 4 else 1.0)

    @property
    def half_width(self) -> float:
        """Half the width over the arms."""
        return self.half_seat + (0.0 if self.armless else self.arm_width)

    @property
    def armless(self) -> bool:
        """Whether nothing stands beside the seat; a Chesterfield's back runs on as its arms."""
        return self.arms == "none" and self.back != "chesterfield"

    @property
    def front(self) -> float:
        """y of the seat's front edge."""
        return -self.seat_depth / 2

    @property
    def rear(self) -> float:
        """y of the frame's back."""
        return self.seat_depth / 2 + self.back_thickness

    @property
    def back_face(self) -> float:
        """y of the back's front where it meets the seat."""
        return self.rear - sofa_backs.upright(self) if self.back == "chesterfield" else self.seat_depth / 2

    @property
    def deck(self) -> float:
        """Height of the board that carries the seat cushions."""
        return self.seat_height - self.cushion_height

    def chaise_span(self) -> tuple[float, float] | None:
        """The chaise's left and right ends in x, or None."""
        if self.chaise == "none":
            return None
        width = min(max(2 * self.half_seat / self.seats, 0.58), 2 * self.half_seat)
        ends = (self.half_seat - width, self.half_seat)
        return ends if self.chaise == "right" else (-ends[1], -ends[0])

    def _frame(self) -> list[Manifold]:
        """The upholstered box below the cushions."""
        rear = self.rear - (0.5 * sofa_backs.upright(self) if self.back == "chesterfield" else 0.012)
        made = [self._slab(-self.half_seat, self.half_seat, self.front + 0.014, rear)]
        if span := self.chaise_span():
            front = self.front - self.chaise_length
            made.append(self._slab(*span, front + 0.014, self.front + 0.2))
        return made

    def _slab(self, left: float, right: float, front: float, rear: float, low: float | None = None):
        low, inset = (self.leg_height, 0.0) if low is None else (low, 0.045)
        size = (right - left - 2 * inset, rear - front - 2 * inset, self.deck - low)
        return parts.rounded_box(size, ((left + right) / 2, (front + rear) / 2, (self.deck + low) / 2), 0.012)

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
        return parts.mirrored(parts.union([self._rolled_arm(), *self._wing()]))

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
        centre = self.half_seat + radius - 0.012
        top = self.seat_height + self.arm_height - radius
        width = 0.84 * self.arm_width
        roll = CrossSection.circle(radius, 32).translate((centre, top))
        upright = CrossSection.square((width, top - self.leg_height))
        upright = upright.translate((self.half_seat - 0.002, self.leg_height))
        arm = Manifold.extrude(roll + upright, self.rear - self.front - 0.03)
        return arm.rotate((90, 0, 0)).translate((0, self.rear - 0.012, 0))

    def _wing(self) -> list[Manifold]:
        """A side panel that shelters the head, in the plane of y and z."""
        if self.arms != "wing":
            return []
        rise, base, front = self.back_height, self.seat_height, 0.12 * self.seat_depth
        corners = [(self.rear - 0.02, base - 0.1, 0), (0.02 * self.seat_depth, base - 0.1, 0)]
        corners += [(front, base + 0.7 * self.arm_height, 0), (front, base + 0.97 * rise, 0)]
        corners.append((self.rear + self.back_lean - 0.04, base + 0.99 * rise, 0))
        corners.append((self.rear + 0.5 * self.back_lean - 0.03, base + 0.4 * rise, 0))
        curve = parts.filleted(corners, 0.07)[::-1, :2]
        thick = 0.055 + 0.1 * self.arm_width
        panel = Manifold.extrude(CrossSection([curve]), thick)
        turned = panel.transform(np.array([[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0]], float))
        return [turned.translate((self.half_seat - 0.004, 0, 0))]

    def _corners(self) -> list[np.ndarray]:
        """[2] outer corners of what stands on the floor: pairs from left to right."""
        x, tuck = self.half_width, 0.0
        middle = [] if x < 0.95 else [0.0]
        if self.back == "chesterfield":  # its corners are round
            x, tuck = self.half_seat + sofa_backs.upright(self), 0.3 * sofa_backs.corner(self)
        made = [np.array([c, self.front]) for c in (-x, *middle, x)]
        behind = [(tuck - x, tuck), *((c, 0.0) for c in middle), (x - tuck, tuck)]
        made += [np.array([c, self.rear - inset]) for c, inset in behind]
        if span := self.chaise_span():
            made += [np.array([c, self.front - self.chaise_length]) for c in span]
        return made

    def _legs(self) -> list[Manifold]:
        if self.legs == "sled":
            return self._sled()
        if self.legs == "plinth":
            x, rear = self.half_width, self.rear
            if self.back == "chesterfield":
                x, rear = self.half_seat + 0.02, rear - 0.5 * sofa_backs.upright(self)
            made = [self._slab(-x, x, self.front, rear, 0.0)]
            if span := self.chaise_span():
                made.append(self._slab(*span, self.front - self.chaise_length, self.front + 0.2, 0.0))
            return made
        return [self._leg(corner) for corner in self._corners()]

    def _leg(self, corner: np.ndarray) -> Manifold:
        w, z = self.leg_width, self.leg_height + 0.025
        inset = 0.05 + 0.5 * w
        towards = np.array([np.sign(corner[0]), 1.0 if corner[1] > 0 else -1.0])
        if corner[1] < self.front - 1e-9 and (span := self.chaise_span()):
            left, right = span
            towards[0] = 1.0 if corner[0] > (left + right) / 2 else -1.0
        top = np.array([*(corner - inset * towards), z])
        foot = np.array([*(top[:2] + self.leg_splay * towards), 0.0])
        if self.legs == "block":
            return parts.square_bar((*top[:2], 0.0), top, 1.25 * w, 1.5 * w)
        if self.legs == "tapered":
            return parts.bar(foot, top, 0.45 * w, 0.75 * w)
        bun = [(0.5, 0), (0.62, 0.06), (0.95, 0.25), (1.05, 0.42), (0.9, 0.58), (0.55, 0.66)]
        bun += [(0.75, 0.7), (0.75, 0.76), (0.9, 0.8), (0.9, 1.0)]
        return parts.turned((*top[:2], 0.0), top, parts.scaled(bun, w))

    def _sled(self) -> list[Manifold]:
        """Loops of bent tube that run from front to back."""
        r, x = 0.42 * self.leg_width, self.half_width - 0.09
        loops = [(c, self.front) for c in ([-x, x] if x < 0.95 else [-x, 0.0, x])]
        if span := self.chaise_span():
            loops += [(c, self.front - self.chaise_length) for c in (span[0] + 0.09, span[1] - 0.09)]
        made = []
        for c, front in loops:
            top, near, far = self.leg_height + 0.03, front + 0.07, self.rear - 0.08
            out = 0.5 * self.leg_splay
            corners = [(c, near, top), (c, near - out, r), (c, far + out, r), (c, far, top)]
            made.append(parts.tube(parts.filleted(corners, 0.04), r, up=(1, 0, 0)))
        return made
