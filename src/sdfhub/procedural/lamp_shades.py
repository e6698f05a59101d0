"""Shades of lamps: thin open shells, the bulb inside them and the wires that hold them."""

import numpy as np
from manifold3d import Manifold

from sdfhub.procedural import parts
from sdfhub.procedural.parts import rod

_THIRDS = parts.spokes(3, 0.5)


def head(lamp, hung: bool) -> Manifold:
    """The shade with its bulb and fitting; the axis is z, the lower rim of the shade lies at z = 0.

    A hung one is held from above by a rod that ends above it, another from below by one that ends under it.
    """
    build = {"dome": _dome, "globe": _globe, "bowl": _bowl}.get(lamp.shade, _open)
    return parts.union(build(lamp, lamp.shade_tall, lamp.gauge, hung))


def _bulb(centre: float, radius: float, gauge: float, up: int) -> list[Manifold]:
    """A bulb and its socket; the bulb is above it where `up` is 1, below it where it is -1."""
    low, high = sorted([centre, centre - up * 1.75 * radius])
    socket = max(0.55 * radius, 1.5 * gauge)
    return [parts.ellipsoid((radius, radius, 1.2 * radius), (0, 0, centre), 20), rod(low, high, socket)]


def _radius(lamp, share):
    """Radius of an open shade at a share of its height."""
    wide = lamp.diameter / 2
    if lamp.shade == "drum":
        return wide * (1 - 0.25 * (1 - lamp.shade_taper) * share)
    if lamp.shade == "bell":
        return wide * (lamp.shade_taper + (1 - lamp.shade_taper) * (1 - share) ** 2.2) * (1 - 0.08 * share)
    return wide * (1 - (1 - lamp.shade_taper) * share)


def _pleated(lamp, tall: float) -> Manifold:
    """A cone whose wall is folded into sharp pleats."""
    fold = np.where(np.arange(2 * lamp.pleats) % 2, 1 - 0.9 / lamp.pleats, 1.0)[:, None]
    ring = parts.circle(2 * lamp.pleats) * fold

    def solid(offset: float, overshoot: float) -> Manifold:
        shares = -overshoot, 1 + overshoot
        return parts.loft([parts.level((_radius(lamp, s) + offset) * ring, s * tall) for s in shares])

    return solid(0.6 * lamp.shade_wall, 0.0) - solid(-0.6 * lamp.shade_wall, 0.05)


def _open(lamp, tall: float, gauge: float, hung: bool) -> list[Manifold]:
    """A shade open at both ends, on a spider of three wires."""
    if lamp.shade == "pleated":
        shell = _pleated(lamp, tall)
    else:
        share = np.linspace(0, 1, 12 if lamp.shade == "bell" else 2)
        profile = np.column_stack([_radius(lamp, share), tall * share])
        shell = parts.revolve_shell(profile, lamp.shade_wall, 40)
    size, at = 0.2 * lamp.diameter * lamp.shade_taper, 0.9
    made = [shell, *_spider(lamp, tall, at, gauge)]
    if hung:
        return [*made, *_bulb(0.45 * tall, size, gauge, -1), rod(0.5 * tall, tall + 2 * gauge, gauge)]
    made += _bulb(0.42 * tall, size, gauge, 1)
    if lamp.fitting == "harp":
        made += [*_harp(tall, at, gauge, 1.45 * size), rod(-2 * gauge, 0.42 * tall, gauge)]
    else:
        made.append(rod(-2 * gauge, at * tall, gauge))
    if lamp.fitting == "rings":
        made += _spider(lamp, tall, 0.08, gauge)
    if lamp.finial:
        top, knob = at * tall, max(at * tall + 4 * gauge, tall)
        made.append(rod(top - gauge, top + 3 * gauge, 0.9 * gauge))
        made.append(parts.ellipsoid((1.9 * gauge, 1.9 * gauge, 2.3 * gauge), (0, 0, knob), 16))
        made.append(rod(top, knob, 0.9 * gauge))
    return made


def _spider(lamp, tall: float, share: float, gauge: float) -> list[Manifold]:
    reach, z = _radius(lamp, share), share * tall
    reach *= 1 - (0.9 / lamp.pleats if lamp.shade == "pleated" else 0.0)
    wires = [parts.bar((0, 0, z), reach * out + [0, 0, z], 0.8 * gauge) for out in _THIRDS]
    return [*wires, rod(z - 1.3 * gauge, z + 1.3 * gauge, 2 * gauge)]


def _harp(tall: float, share: float, gauge: float, wide: float) -> list[Manifold]:
    """Two bent wires around the bulb from the socket to the spider."""
    low, high = 0.06 * tall, share * tall
    corners = [(0, 0, low), (wide, 0, low + 0.3 * (high - low)), (0.9 * wide, 0, high - 0.3 * wide)]
    path = parts.filleted([*corners, (0, 0, high)], 0.3 * wide)
    return parts.mirrored(parts.tube(path, 0.8 * gauge, 10, up=(0, 1, 0)))


def _dome(lamp, tall: float, gauge: float, hung: bool) -> list[Manifold]:
    """A dome closed by a cap, where the rod holds it."""
    wide, cap, angle = lamp.diameter / 2, 2.4 * gauge, np.linspace(0, 0.5 * np.pi, 13)
    radius = 0.7 * cap + (wide - 0.7 * cap) * np.cos(angle) ** (0.7 + 0.6 * lamp.shade_taper)
    profile = np.column_stack([radius, tall * np.sin(angle)])
    size = min(0.36 * wide, 0.3 * tall)
    crown = [(1.3 * cap, tall - gauge), (cap, tall + 1.5 * gauge), (gauge, tall + 3 * gauge)]
    made = [parts.revolve_shell(profile, lamp.shade_wall, 40), parts.lathe(crown)]
    if hung:
        return [*made, *_bulb(0.42 * tall, size, gauge, -1), rod(0.42 * tall, tall + 4 * gauge, gauge)]
    return [*made, *_bulb(0.4 * tall, size, gauge, 1), rod(-2 * gauge, tall, gauge)]


def _globe(lamp, tall: float, gauge: float, hung: bool) -> list[Manifold]:
    """A ball of glass, open opposite to the collar that holds it."""
    wide, cap = lamp.diameter / 2, 3.2 * gauge
    first, last = np.arcsin(0.7 * cap / wide), np.pi - np.arcsin(0.3 + 0.45 * lamp.shade_taper)
    angle = np.linspace(first, last, 19)
    profile = np.column_stack([wide * np.sin(angle), tall / 2 * (1 - np.cos(angle))])
    made = [parts.revolve_shell(profile, lamp.shade_wall, 36)]
    made.append(parts.lathe([(0.9 * gauge, -3 * gauge), (cap, -1.5 * gauge), (1.2 * cap, 2.4 * gauge)]))
    made += [*_bulb(0.42 * tall, 0.3 * wide, gauge, 1), rod(-3.5 * gauge, 0.4 * tall, gauge)]
    ball = parts.union(made).translate((0, 0, 0.6 * gauge))
    return [ball.rotate((180, 0, 0)).translate((0, 0, tall))] if hung else [ball]


def _bowl(lamp, tall: float, gauge: float, hung: bool) -> list[Manifold]:
    """A bowl that throws its light up; hung, it is carried by three rods."""
    wide, cap, share = lamp.diameter / 2, 2.6 * gauge, np.linspace(0, 1, 12)
    radius = 0.7 * cap + (wide - 0.7 * cap) * share
    profile = np.column_stack([radius, tall * share ** (1.3 + 1.5 * lamp.shade_taper)])
    size = min(0.3 * wide, 0.3 * tall)
    made = [parts.revolve_shell(profile, lamp.shade_wall, 40)]
    made.append(parts.lathe([(gauge, -3 * gauge), (1.2 * cap, -gauge), (1.3 * cap, 2 * gauge)]))
    made += [rod(0, 0.5 * tall, gauge), *_bulb(0.5 * tall, size, gauge, 1)]
    if not hung:
        return [*made, rod(-4 * gauge, 0, gauge)]
    apex = tall + 1.1 * wide
    made += [parts.bar(0.97 * wide * out + [0, 0, 0.97 * tall], (0, 0, apex), 0.8 * gauge) for out in _THIRDS]
    return [*made, parts.ellipsoid((2 * gauge,) * 3, (0, 0, apex), 16), rod(apex, apex + 3 * gauge, gauge)]
