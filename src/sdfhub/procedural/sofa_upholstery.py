"""What is stuffed of a sofa: its back of many fronts, seat cushions, throw pillows, bolsters."""

import numpy as np
from manifold3d import Manifold

from sdfhub.procedural import parts


def back(sofa) -> list[Manifold]:
    """The parts of the sofa's back, rooted in its frame."""
    styles = dict(tight=_tight, cushions=_cushions, channels=_channels, camel=_camel, tufted=_tufted)
    return styles.get(sofa.back, _chesterfield)(sofa)


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
    return parts.loft(sections)


def _level(sofa, count: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """A level top: stations x [count] of the back from left to right, and its height there."""
    x = np.linspace(-sofa.half_back, sofa.half_back, count)
    return x, np.full(count, sofa.seat_height + sofa.back_height)


def _tight(sofa) -> list[Manifold]:
    x, top = _level(sofa, 25)
    inner = np.clip(1 - (x / sofa.half_seat) ** 6, 0, 1)
    return [_wall(sofa, x, top, 0.5 * sofa.crown * inner)]


def _channels(sofa) -> list[Manifold]:
    """Vertical rolls side by side."""
    count = max(3, round(2 * sofa.half_back / sofa.channel_width))
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

    x, top = _level(sofa, 6 * max(4, round(2 * sofa.half_back / step)) + 1)
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
    for left, right in spans(sofa, sofa.seats):
        # built lying down, then stood up: its crown faces the sitter
        size, centre = (right - left, high - low, thick), ((left + right) / 2, y, middle)
        made.append(cushion(size, centre, 1.1 * r, sofa.crown + 0.012, lean=90.0 - angle))
    return made


def _chesterfield(sofa) -> list[Manifold]:
    """Arms and back of one height: an upright and a roll along its top, round the corners."""
    thick, radius = sofa.wall, 0.4 * sofa.arm_width + 0.03
    x, rear = sofa.half_seat + thick / 2, sofa.rear - thick / 2
    axis, low = sofa.seat_height + sofa.arm_height + 0.1 - radius, sofa.leg_height
    plan = [(-x, sofa.front, 0), (-x, rear, 0), (x, rear, 0), (x, sofa.front, 0)]
    path = parts.filleted(plan, sofa.bend, 8) + [0, 0, axis]
    section = np.array([(-thick / 2, low - axis), (thick / 2, low - axis), (thick / 2, 0), (-thick / 2, 0)])
    return [parts.sweep(path, section), parts.tube(path, radius, 24)]


def cushion(size, centre, radius: float, crown: float, lean: float = 0.0, steps: int = 3) -> Manifold:
    """A rounded box whose +z side swells, `crown` above its rim in the middle, leant by degrees around x."""
    block = parts.rounded_box(size, (0, 0, 0), radius, steps)
    u, v = (g.ravel() for g in np.meshgrid(*2 * [np.linspace(-0.94, 0.94, 7)], indexing="ij"))
    inner = np.asarray(size) / 2 - [0.6 * radius, 0.6 * radius, 0]
    swell = inner[2] + crown * ((1 - u**2) * (1 - v**2)) ** 0.6
    points = np.column_stack([u * inner[0], v * inner[1], swell])
    rim = block.to_mesh64().vert_properties[:, :3]
    solid = Manifold.hull_points(np.ascontiguousarray(np.vstack([rim, points])))
    return solid.rotate((lean, 0, 0)).translate(centre)


def spans(sofa, count: int) -> list[tuple[float, float]]:
    """Left and right ends of `count` cushions side by side; the outer ones run into the arms."""
    edges = np.linspace(-sofa.half_seat, sofa.half_seat, count + 1)
    left, right = edges[:-1] + sofa.gap / 2, edges[1:] - sofa.gap / 2
    reach = -0.004 if sofa.armless else 0.014
    left[0], right[-1] = edges[0] - reach, edges[-1] + reach
    return list(zip(left, right, strict=True))


def seats(sofa) -> list[Manifold]:
    """The cushions one sits on, sunk into the deck by their rounding so that nothing is hollow below them."""
    placed = [(a, b, sofa.front) for a, b in spans(sofa, 1 if sofa.seat == "bench" else sofa.seats)]
    if sofa.chaise_span:
        left, right = sofa.chaise_span
        if sofa.seat == "bench" or right - left > 1.01 * 2 * sofa.half_seat / sofa.seats:
            placed.append((left, right, sofa.chaise_front))
        else:
            at = 0 if sofa.chaise == "left" else -1
            placed[at] = (*placed[at][:2], sofa.chaise_front)
    made, rear = [], sofa.back_face + sofa.cushion_radius + 0.012
    low = sofa.deck - 0.6 * sofa.cushion_radius
    for left, right, front in placed:
        size = (right - left, rear - front, sofa.seat_height - low)
        centre = ((left + right) / 2, (front + rear) / 2, (low + sofa.seat_height) / 2)
        made.append(cushion(size, centre, sofa.cushion_radius, sofa.crown))
    return made


def loose(sofa) -> list[Manifold]:
    """Throw pillows that lean on the back, or a bolster along each arm."""
    if sofa.pillows == "none":
        return []
    back = sofa.back_face - (0.5 * sofa.back_thickness if sofa.back == "cushions" else 0.0)
    if sofa.pillows == "bolsters":
        return _bolsters(sofa, back)
    size = sofa.pillow_size
    x, z = sofa.half_seat - 0.55 * size - 0.02, sofa.seat_height + 0.42 * size
    if sofa.seats == 1:
        return [_pillow(size, (0, back - 0.1, z), 0.0)]
    first = _pillow(size, (x, back - 0.12, z), -18.0)
    if sofa.pillows == "one":
        return [first]
    return [first, _pillow(0.92 * size, (-x, back - 0.12, z - 0.02), 14.0)]


def _bolsters(sofa, back: float) -> list[Manifold]:
    r, length = 0.24 * sofa.pillow_size, min(1.15 * sofa.pillow_size, back - sofa.front - 0.06)
    profile = [(0.3, 0), (0.82, 0.008), (0.95, 0.04), (1, 0.1)]
    profile += [(1, 0.9), (0.95, 0.96), (0.82, 0.992), (0.3, 1)]
    x, z = sofa.half_seat - 0.92 * r, sofa.seat_height + 0.88 * r + 0.3 * sofa.crown
    start, end = (x, back + 0.02 - length, z), (x, back + 0.02, z)
    return parts.mirrored(parts.turned(start, end, profile, r))


def _pillow(size: float, centre, yaw: float) -> Manifold:
    """A square pillow, thick in its middle, with drawn-in sides and pointed corners."""
    t = np.sin(np.linspace(-1, 1, 15) * np.pi / 2)
    around = np.concatenate([t, t[::-1]])
    side = np.repeat([1.0, -1.0], len(t))
    sections = []
    for u in t:
        height = 0.5 * size * (0.92 + 0.08 * u**4) * around
        swell = ((1 - u**2) * (1 - around**2)) ** 0.45
        thick = side * (0.016 + 0.17 * size * swell)
        across = 0.5 * size * u * (0.92 + 0.08 * around**4)
        sections.append(np.column_stack([across, thick, height]))
    leaning = parts.loft(sections).rotate((-17, 0, 0)).rotate((0, 0, yaw))
    return leaning.translate(centre)
