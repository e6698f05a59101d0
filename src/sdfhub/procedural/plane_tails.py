"""Tails of aircraft: fins and tailplanes in the usual arrangements."""

import numpy as np
from manifold3d import Manifold

from sdfhub.procedural import parts
from sdfhub.procedural import plane_parts as pp


def tail(plane) -> list[Manifold]:
    """The plane's fins and tailplanes; engines at the rear push a low tailplane up to the fin's top."""
    style, is_fighter = plane.tail, plane.kind == "fighter"
    if plane.kind == "business jet" and style in ("conventional", "twin"):
        style = "t"
    if style == "v":
        return _low_tailplane(plane, 0.48, np.radians(38), 0.22, 0.14)
    if style == "twin" and not is_fighter:
        return _twin(plane)
    fins = _fighter_fins(plane) if style == "twin" else [_fin(plane)]
    if style in ("twin", "conventional"):
        return fins + _low_tailplane(plane, 0.49, 0.06, 0.19, 0.17 if is_fighter else 0.125)
    if is_fighter and style == "cruciform":
        return fins + _foreplanes(plane)
    return fins + _raised_tailplane(plane, 0.5 if style == "cruciform" else 0.93)


def _surface(plane, root, direction, length: float, chord: float, sweep: float, taper: float = 0.55):
    return pp.panel(root, direction, length, (chord, taper * chord), sweep, 0.1, plane.gauge)


def _fin_frame(plane) -> tuple[np.ndarray, float, float]:
    """Root of the fin's leading edge, its height above that, its root chord."""
    chord = (0.19 if plane.kind == "fighter" else 0.155) * plane.tail_scale
    y = 0.485 - chord
    height = plane.body.half_height(y) + 0.125 * plane.tail_scale
    return np.array([0, y, plane.body.axis(0.47)]), height, chord


def _fin(plane) -> Manifold:
    root, height, chord = _fin_frame(plane)
    return _surface(plane, root, (0, 1), height, chord, plane.fin_angle)


def _tailplane(plane, root, roll: float, length: float, chord: float) -> list[Manifold]:
    """A surface and its mirror image, both from the centre line."""
    direction = np.cos(roll), np.sin(roll)
    return parts.mirrored(_surface(plane, root, direction, length, chord, plane.tail_angle))


def _low_tailplane(plane, rear: float, roll: float, length: float, chord: float) -> list[Manifold]:
    """A tailplane, or a V-tail, that ends at y = `rear`."""
    length, chord = length * plane.tail_scale, chord * plane.tail_scale
    root = np.array([-0.006 if plane.tail == "v" else -0.004, rear - chord, plane.body.axis(0.46)])
    return _tailplane(plane, root, roll, length, chord)


def _raised_tailplane(plane, share: float) -> list[Manifold]:
    root, height, chord = _fin_frame(plane)
    back = share * height * np.tan(np.radians(plane.fin_angle))
    base = root + np.array([-0.004, back - 0.01, share * height])
    return _tailplane(plane, base, 0.0, 0.17 * plane.tail_scale, max(0.62 * chord, 0.09))


def _twin(plane) -> list[Manifold]:
    """A low tailplane with a fin on each of its tips."""
    length, chord = 0.17 * plane.tail_scale, 0.12 * plane.tail_scale
    root = np.array([-0.004, 0.48 - chord, plane.body.axis(0.46)])
    low = root + np.array([length - 0.004, 0.0, -0.045 * plane.tail_scale])
    flat = _surface(plane, root, (1, 0), length, chord, 4, 0.9)
    fin = _surface(plane, low, (0, 1), 0.14 * plane.tail_scale, chord, 14, 0.7)
    return parts.mirrored(flat) + parts.mirrored(fin)


def _fighter_fins(plane) -> list[Manifold]:
    """Two canted fins on the body's shoulders."""
    chord, cant, body = 0.165 * plane.tail_scale, np.radians(74), plane.body
    y = 0.47 - chord
    root = np.array([0.5 * body.half_width(0.4), y, body.axis(0.45) + 0.1 * body.radius])
    height, direction = body.half_height(y) + 0.1 * plane.tail_scale, (np.cos(cant), np.sin(cant))
    return parts.mirrored(_surface(plane, root, direction, height, chord, plane.fin_angle, 0.5))


def _foreplanes(plane) -> list[Manifold]:
    """Canards behind the cockpit instead of a tailplane."""
    root = np.array([-0.004, -0.31, plane.body.axis(-0.26) + 0.3 * plane.body.half_height(-0.26)])
    return _tailplane(plane, root, 0.05, 0.15 * plane.tail_scale, 0.1)
