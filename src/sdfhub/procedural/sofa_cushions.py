"""What lies loose on a sofa: seat cushions, throw pillows, bolsters."""

import numpy as np
from manifold3d import Manifold

from sdfhub.procedural import parts


def cushion(size, centre, radius: float, crown: float, lean: float = 0.0, steps: int = 3) -> Manifold:
    """A rounded box whose +z side swells, `crown` above its rim in the middle, leant by degrees around x."""
    block = parts.rounded_box(size, (0, 0, 0), radius, steps)
    u, v = (g.ravel() for g in np.meshgrid(*2 * [np.linspace(-0.94, 0.94, 7)], indexing="ij"))
    inner = np.asarray(size) / 2 - [0.6 * radius, 0.6 * radius, 0]
    swell = inner[2] + crown * ((1 - u**2) * (1 - v**2)) ** 0.6
    points = np.column_stack([u * inner[0], v * inner[1], swell])
    rim = block.to_mesh64().vert_properties[:, :3]
    solid = Manifold.hull_points(np.ascontiguousarray(np.vstack([rim, points])))
    return solid.rotate((lean, 0, 0)).translate(tuple(map(float, centre)))


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
    if chaise := sofa.chaise_span():
        front = sofa.front - sofa.chaise_length
        if sofa.seat == "bench" or chaise[1] - chaise[0] > 1.01 * 2 * sofa.half_seat / sofa.seats:
            placed.append((chaise[0], chaise[1], front))
        else:
            at = 0 if sofa.chaise == "left" else -1
            placed[at] = (*placed[at][:2], front)
    made = []
    for left, right, front in placed:
        rear, low = sofa.back_face + sofa.cushion_radius + 0.012, sofa.deck - 0.6 * sofa.cushion_radius
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
    z = sofa.seat_height + 0.42 * size
    x = sofa.half_seat - 0.55 * size - 0.02
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
    return parts.mirrored(parts.turned(start, end, parts.scaled(profile, r)))


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
    leaning = parts.loft(np.array(sections)).rotate((-17, 0, 0)).rotate((0, 0, yaw))
    return leaning.translate(tuple(map(float, centre)))
