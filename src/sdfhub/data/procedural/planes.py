"""Aircraft: airliners, business jets, turboprops, light singles, gliders, fighters, from one set of parameters."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from manifold3d import Manifold

from sdfhub.data.procedural import parts, plane_tails
from sdfhub.data.procedural import plane_parts as pp
from sdfhub.data.procedural.parameters import choice, continuous


class Proportions(NamedTuple):
    """What makes a kind of aircraft that kind; lengths in fuselage lengths, angles in degrees."""

    length: float  # metres
    radius: float
    tall: float
    nose: float
    tail: float
    tip: float
    end: float
    bluntness: float
    boom: float
    square: float
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
        38, 0.052, 1, 0.12, 0.38, 0.06, 0.16, 0.55, 1.15, 2, 0.96, 0.22, 0.26, 31, -0.13, 1.0, 0.06, 0.019
    ),
    "business jet": Proportions(
        18, 0.06, 1, 0.2, 0.42, 0.07, 0.18, 0.62, 1.1, 2, 0.94, 0.2, 0.32, 28, -0.06, 1.0, 0.05, 0.018
    ),
    "turboprop": Proportions(
        25, 0.056, 1.05, 0.14, 0.4, 0.1, 0.2, 0.55, 1.1, 2.2, 1.08, 0.13, 0.5, 4, -0.1, 1.05, 0.06, 0.021
    ),
    "single": Proportions(
        8, 0.07, 1.12, 0.16, 0.62, 0.62, 0.2, 0.5, 0.9, 2.7, 1.3, 0.18, 0.72, 2, -0.2, 1.1, 0.085, 0.031
    ),
    "glider": Proportions(
        7, 0.058, 1.15, 0.24, 0.6, 0.1, 0.3, 0.6, 0.75, 2.1, 2.1, 0.125, 0.42, 1.5, -0.16, 1.0, 0.014, 0.03
    ),
    "fighter": Proportions(
        15, 0.054, 1.0, 0.36, 0.3, 0.05, 0.8, 0.75, 1.0, 2.4, 0.66, 0.4, 0.16, 46, -0.06, 1.05, 0.055, 0.022
    ),
}


@dataclass(frozen=True)
class Plane:
    """One aircraft, its nose towards -y. The numbers scale or shift the proportions of its kind."""

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
        solids = [body, self._wing(), *plane_tails.tail(self), *self._powerplant(), *self._canopy(), *self._gear()]
        return parts.union(solids).scale((self.base.length * self.size,) * 3)
