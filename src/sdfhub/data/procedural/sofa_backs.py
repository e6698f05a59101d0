"""Backs of sofas: stuffed walls of many fronts, loose cushions, and the Chesterfield's running roll."""

import numpy as np
from manifold3d import Manifold

from sdfhub.data.procedural import parts, sofa_cushions


def back(sofa) -> list[Manifold]:
    """The parts of the sofa's back, rooted in its frame."""
    styles = {
        "tight": _tight,
        "cushions": _cushions,
        "channels": _channels,
        "camel": _camel,
        "tufted": _tufted,
        "chesterfield": _chesterfield,
    }
    return styles[sofa.back](sofa)


def _half(sofa) -> float:
    """Half the back's width: to the outside of the arms, a little short of it."""
    return sofa.half_seat if sofa.armless else sofa.half_seat + 0.72 * sofa.arm_width


def _lean(sofa, z):
    """How far the back has moved to +y at height z."""
    return sofa.back_lean * np.clip((z - sofa.seat_height) / sofa.back_height, 0, None)


def _wall(
    sofa, x: np.ndarray, top: np.ndarray, push: np.ndarray | float = 0.0, radius: float = 0.045
) -> Manifold:
    """A leaning wall with rounded top and ends.

    Args:
        sofa: whose back it is.
        x: [K] increasing stations from the left end to the right.
        top: [K] heights there.
        push: [K] how far the front swells towards -y.
        radius: of the rounding.
    """
    push = np.broadcast_to(push, x.shape)
    thick, low = sofa.back_thickness, sofa.leg_height
    r = min(radius, 0.45 * thick)
    turn = np.linspace(0, np.pi / 2, 5)
    ends = r * (1 - np.sin(turn[:-1]))  # inset of the wall where it rounds off
    left = x[0] + r * (1 - np.cos(turn[:-1]))
    inside = (x > x[0] + r) & (x < x[-1] - r)
    stations = np.concatenate([left, x[inside], (x[0] + x[-1] - left)[::-1]])
    inset = np.concatenate([ends, np.zeros(inside.sum()), ends[::-1]])
    sections = []
    for s, cut in zip(stations, inset, strict=True):
        high, swell = np.interp(s, x, top) - cut, np.interp(s, x, push)
        front = np.linspace(low, high - r, 8)
        t = np.concatenate([np.full(8, cut), cut + r * (1 - np.cos(turn[1:]))])
        z = np.concatenate([front, high - r + r * np.sin(turn[1:])])
        t = t - swell * np.clip((high - z) / 0.1, 0, 1) ** 0.5
        back_t = np.concatenate([thick - cut - r + r * np.cos(turn[::-1]), [thick - cut] * 2])
        back_z = np.concatenate([high - r + r * np.sin(turn[::-1]), [sofa.seat_height, low]])
        t, z = np.concatenate([t, back_t]), np.concatenate([z, back_z])
        y = sofa.seat_depth / 2 + t + _lean(sofa, z)
        sections.append(np.column_stack([np.full(len(z), s), y, z]))
    return parts.loft(np.array(sections))


def _level(sofa, count: int = 2) -> tuple[np.ndarray, np.ndarray]:
    half = _half(sofa)
    x = np.linspace(-half, half, count)
    return x, np.full(count, sofa.seat_height + sofa.back_height)


def _tight(sofa) -> list[Manifold]:
    x, top = _level(sofa, 41)
    inner = np.clip(1 - (x / sofa.half_seat) ** 6, 0, 1)
    return [_wall(sofa, x, top, 0.5 * sofa.crown * inner)]


def _channels(sofa) -> list[Manifold]:
    """Vertical rolls side by side."""
    count = max(3, round(2 * _half(sofa) / sofa.channel_width))
    x, top = _level(sofa, 8 * count + 1)
    wave = np.abs(np.sin(np.pi * np.arange(8 * count + 1) / 8))
    return [_wall(sofa, x, top + 0.012 * wave, 0.06 * wave**0.7 - 0.01)]


def _camel(sofa) -> list[Manifold]:
    """A top that rises to a hump in the middle and sweeps up again to the ends."""
    x, top = _level(sofa, 61)
    u = x / x[-1]
    rise = np.exp(-((u / 0.42) ** 2)) + 0.25 * u**6
    return [_wall(sofa, x, top - 0.06 + sofa.hump * rise)]


def _tufted(sofa) -> list[Manifold]:
    """A tight back whose front is drawn in by buttons in a diamond pattern."""
    step = 0.95 * sofa.channel_width
    half = sofa.half_seat - 0.07
    depth = 0.035
    wall = _wall(sofa, *_level(sofa, 3))
    dents = []
    heights = np.arange(sofa.seat_height + 0.1, sofa.seat_height + sofa.back_height - 0.05, 0.6 * step)
    for row, z in enumerate(heights):
        count = max(2, round(2 * half / step)) - row % 2
        shift = half - (row % 2) * half / max(2, round(2 * half / step))
        for x in np.linspace(-shift, shift, max(count, 1) + 1 - 0):
            y = sofa.seat_depth / 2 + _lean(sofa, z)
            dents.append(parts.ellipsoid((0.4 * step, depth, 0.34 * step), (x, y, z), 12))
    return [wall - parts.union(dents)]


def _cushions(sofa) -> list[Manifold]:
    """A thin wall with a loose cushion for every seat before it."""
    x, top = _level(sofa)
    made = [_wall(sofa, x, top - 0.05)]
    angle = np.degrees(np.arctan2(sofa.back_lean, sofa.back_height))
    thick, r = 0.95 * sofa.back_thickness, sofa.cushion_radius
    low, high = sofa.seat_height - 0.03, sofa.seat_height + sofa.back_height + 0.03
    middle = (low + high) / 2
    y = sofa.seat_depth / 2 + _lean(sofa, middle) - 0.5 * thick + 0.8 * r
    for left, right in sofa_cushions.spans(sofa, sofa.seats):
        # built lying down, then stood up: its crown faces the sitter
        size, centre = (right - left, high - low, thick), ((left + right) / 2, y, middle)
        made.append(sofa_cushions.cushion(size, centre, 1.1 * r, sofa.crown + 0.012, lean=90.0 - angle))
    return made


def _chesterfield(sofa) -> list[Manifold]:
    """Arms and back of one height: an upright and a roll along its top, round the corners."""
    roll = 0.4 * sofa.arm_width + 0.03
    thick = 0.8 * sofa.arm_width
    x, front, rear = sofa.half_seat + thick / 2, sofa.front + 0.012, sofa.rear - thick / 2
    top = sofa.seat_height + sofa.arm_height + 0.1
    corner = 0.14 + 0.5 * sofa.hump
    plan = [(-x, front, 0), (-x, rear, 0), (x, rear, 0), (x, front, 0)]
    path = parts.filleted(plan, corner, 8)
    middle = (sofa.leg_height + top - roll) / 2
    tall = top - roll - sofa.leg_height
    section = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * np.array([thick, tall]) / 2
    wall = parts.sweep(path + [0, 0, middle], section)
    bead = parts.tube(path + [0, 0, top - roll], roll, 24)
    deck = sofa.deck
    fill = parts.box(
        (2 * sofa.half_seat, sofa.back_thickness + 0.1, deck - sofa.leg_height - 0.02),
        (0, rear - sofa.back_thickness / 2 - 0.05, (deck + sofa.leg_height) / 2),
    )
    return [parts.union([wall, bead]), fill]
