"""Tails of aircraft: fins and tailplanes in the usual arrangements."""

import numpy as np
from manifold3d import Manifold

from sdfhub.procedural import parts
from sdfhub.procedural import plane_parts as pp

_RATIO = 0.1


def tail(plane) -> list[Manifold]:
    """The plane's fins and tailplanes; engines at the rear push a low tailplane up to the fin's top."""
    style = plane.tail
    if plane.kind == "business jet" and style in ("conventional", "twin"):
        style = "t"
    if style == "v":
        return _vee(plane)
    if style == "twin":
        return _fighter_fins(plane) + _low_tailplane(plane) if plane.kind == "fighter" else _twin(plane)
    if plane.kind == "fighter" and style == "cruciform":
        return [_fin(plane), *_foreplanes(plane)]
    fin = [_fin(plane)]
    if style == "conventional":
        return fin + _low_tailplane(plane)
    return fin + _raised_tailplane(plane, 0.5 if style == "cruciform" else 0.93)


def _sweeps(plane) -> tuple[float, float]:
    """Sweep of the fin and of the tailplane, degrees."""
    fast = plane.kind in ("airliner", "business jet", "fighter")
    return (40 if fast else 24) + plane.fin_sweep, (34 if fast else 8) + 0.5 * plane.fin_sweep


def _size(plane) -> float:
    return plane.base.tail_size * plane.tail_size


def _fin_frame(plane) -> tuple[np.ndarray, float, float]:
    """Root of the fin's leading edge, its height above that, its root chord."""
    chord = (0.19 if plane.kind == "fighter" else 0.155) * _size(plane)
    y = 0.485 - chord
    z = plane.body.axis(0.47)
    return np.array([0, y, z]), plane.body.half_height(y) + 0.125 * _size(plane), chord


def _fin(plane) -> Manifold:
    root, height, chord = _fin_frame(plane)
    return pp.panel(root, (0, 1), height, (chord, 0.55 * chord), _sweeps(plane)[0], _RATIO, plane.gauge)


def _plane_at(plane, root, roll: float, length: float, chord: float) -> list[Manifold]:
    """A panel and its mirror image, both from the centre line."""
    direction = (np.cos(roll), np.sin(roll))
    half = pp.panel(root, direction, length, (chord, 0.55 * chord), _sweeps(plane)[1], _RATIO, plane.gauge)
    return parts.mirrored(half)


def _low_tailplane(plane) -> list[Manifold]:
    chord = (0.17 if plane.kind == "fighter" else 0.125) * _size(plane)
    y = 0.49 - chord
    root = np.array([-0.004, y, plane.body.axis(0.46)])
    return _plane_at(plane, root, 0.06, 0.19 * _size(plane), chord)


def _raised_tailplane(plane, share: float) -> list[Manifold]:
    root, height, chord = _fin_frame(plane)
    back = share * height * np.tan(np.radians(_sweeps(plane)[0]))
    base = root + np.array([-0.004, back - 0.01, share * height])
    return _plane_at(plane, base, 0.0, 0.17 * _size(plane), max(0.62 * chord, 0.09))


def _vee(plane) -> list[Manifold]:
    chord = 0.14 * _size(plane)
    root = np.array([-0.006, 0.48 - chord, plane.body.axis(0.46)])
    return _plane_at(plane, root, np.radians(38), 0.22 * _size(plane), chord)


def _twin(plane) -> list[Manifold]:
    """A low tailplane with a fin on each of its tips."""
    length, chord = 0.17 * _size(plane), 0.12 * _size(plane)
    root = np.array([-0.004, 0.48 - chord, plane.body.axis(0.46)])
    flat = pp.panel(root, (1, 0), length, (chord, 0.9 * chord), 4, _RATIO, plane.gauge)
    low = root + np.array([length - 0.004, 0.0, -0.045 * _size(plane)])
    fin = pp.panel(low, (0, 1), 0.14 * _size(plane), (chord, 0.7 * chord), 14, _RATIO, plane.gauge)
    return parts.mirrored(flat) + parts.mirrored(fin)


def _fighter_fins(plane) -> list[Manifold]:
    """Two canted fins on the body's shoulders."""
    chord, cant = 0.165 * _size(plane), np.radians(74)
    y = 0.47 - chord
    root = np.array([0.5 * plane.body.half_width(0.4), y, plane.body.axis(0.45) + 0.1 * plane.body.radius])
    height = plane.body.half_height(y) + 0.1 * _size(plane)
    direction = (np.cos(cant), np.sin(cant))
    fin = pp.panel(root, direction, height, (chord, 0.5 * chord), _sweeps(plane)[0], _RATIO, plane.gauge)
    return parts.mirrored(fin)


def _foreplanes(plane) -> list[Manifold]:
    """Canards behind the cockpit instead of a tailplane."""
    root = np.array([-0.004, -0.31, plane.body.axis(-0.26) + 0.3 * plane.body.half_height(-0.26)])
    return _plane_at(plane, root, 0.05, 0.15 * _size(plane), 0.1)
