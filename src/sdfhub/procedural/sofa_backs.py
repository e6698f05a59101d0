"""Backs of sofas: stuffed walls of many fronts, loose cushions, and the Chesterfield's running roll."""

import numpy as np
from manifold3d import Manifold

from sdfhub.procedural import parts, sofa_cushions


def back(sofa) -> list[Manifold]:
    """The parts of the sofa's back, rooted in its frame."""
    styles = dict(tight=_tight, cushions=_cushions, channels=_channels, camel=_camel, tufted=_tufted)
    return styles.get(sofa.back, _chesterfield)(sofa)


def _half(sofa) -> float:
    """Half the back's width: to the outside of the arms, a little short of it."""
    return sofa.half_seat if sofa.armless else sofa.half_seat + 0.72 * sofa.arm_width


def _lean(sofa, z):
    """How far the back has moved to +y at height z."""
    return sofa.back_lean * np.clip((z - sofa.seat_height) / sofa.back_height, 0, None)


def _wall(sofa, x: np.ndarray, top: np.ndarray, push=0.0, rows: int = 8) -> Manifold:
    """A leaning wall with rounded top and ends, `top` [K] high at stations x [K] from left to right.

    Its front of `rows` facets swells by `push` towards -y: a number, [K], or a function of (x, heights).
    """
    swelling = push if callable(push) else lambda s, z: np.interp(s, x, np.broadcast_to(push, x.shape))
    thick, low = sofa.back_thickness, sofa.leg_height
    r = min(0.045, 0.45 * thick)
    turn = np.linspace(0, np.pi / 2, 5)
    ends = r * (1 - np.sin(turn[:-1]))  # inset of the wall where it rounds off
    left = x[0] + r * (1 - np.cos(turn[:-1]))
    inside = (x > x[0] + r) & (x < x[-1] - r)
    stations = np.concatenate([left, x[inside], (x[0] + x[-1] - left)[::-1]])
    inset = np.concatenate([ends, np.zeros(inside.sum()), ends[::-1]])
    sections = []
    for s, cut in zip(stations, inset, strict=True):
        high = np.interp(s, x, top) - cut
        front = np.concatenate([[low], np.linspace(sofa.deck, high - r, rows)])
        t = np.concatenate([np.full(rows + 1, cut), cut + r * (1 - np.cos(turn[1:]))])
        z = np.concatenate([front, high - r + r * np.sin(turn[1:])])
        t = t - swelling(s, z) * np.clip((high - z) / 0.1, 0, 1) ** 0.5
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
    x, top = _level(sofa, 25)
    inner = np.clip(1 - (x / sofa.half_seat) ** 6, 0, 1)
    return [_wall(sofa, x, top, 0.5 * sofa.crown * inner)]


def _channels(sofa) -> list[Manifold]:
    """Vertical rolls side by side."""
    count = max(3, round(2 * _half(sofa) / sofa.channel_width))
    x, top = _level(sofa, 6 * count + 1)
    wave = np.abs(np.sin(np.pi * np.arange(6 * count + 1) / 6))
    return [_wall(sofa, x, top + 0.012 * wave, 0.06 * wave**0.7 - 0.01)]


def _camel(sofa) -> list[Manifold]:
    """A top that rises to a hump in the middle and sweeps up again to the ends."""
    x, top = _level(sofa, 41)
    u = x / x[-1]
    rise = np.exp(-((u / 0.42) ** 2)) + 0.25 * u**6
    return [_wall(sofa, x, top - 0.06 + sofa.hump * rise)]


def _tufted(sofa) -> list[Manifold]:
    """A tight back drawn in along the diagonals, so that diamonds of stuffing stand out."""
    step = 2 * sofa.half_seat / max(2, round(2 * sofa.half_seat / sofa.channel_width))

    def diamonds(x: float, z: np.ndarray) -> np.ndarray:
        u, v = x / step, (z - sofa.seat_height) / (1.15 * step)
        inner = np.clip((sofa.half_seat - abs(x)) / 0.05, 0, 1)
        return 0.055 * inner * np.abs(np.sin(np.pi * (u + v)) * np.sin(np.pi * (u - v))) ** 0.5

    x, top = _level(sofa, 6 * max(4, round(2 * _half(sofa) / step)) + 1)
    return [_wall(sofa, x, top, diamonds, 18)]


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
    thick, radius = upright(sofa), 0.4 * sofa.arm_width + 0.03
    x, rear = sofa.half_seat + thick / 2, sofa.rear - thick / 2
    axis, low = sofa.seat_height + sofa.arm_height + 0.1 - radius, sofa.leg_height
    plan = [(-x, sofa.front, 0), (-x, rear, 0), (x, rear, 0), (x, sofa.front, 0)]
    path = parts.filleted(plan, corner(sofa), 8) + [0, 0, axis]
    section = np.array([(-thick / 2, low - axis), (thick / 2, low - axis), (thick / 2, 0), (-thick / 2, 0)])
    return [parts.sweep(path, section), parts.tube(path, radius, 24)]


def upright(sofa) -> float:
    """Thickness of the Chesterfield's wall."""
    return 0.8 * sofa.arm_width


def corner(sofa) -> float:
    """How far from its corners the Chesterfield's wall begins to turn."""
    return 0.14 + 0.5 * sofa.hump
