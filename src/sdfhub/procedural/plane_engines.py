"""Engines of aircraft, what carries them, and landing gear."""

import numpy as np
from manifold3d import Manifold

from sdfhub.procedural import parts
from sdfhub.procedural import plane_parts as pp


def powerplant(plane) -> list[Manifold]:
    """The engines that the plane's kind has; its `engines` doubles their number where that can be."""
    kinds = {"airliner": _underwing_jets, "business jet": _rear_jets, "turboprop": _wing_propellers}
    kinds |= {"single": _nose_propeller, "fighter": _afterburners}
    return kinds[plane.kind](plane) if plane.kind in kinds else []


def _underwing_jets(plane) -> list[Manifold]:
    """Nacelles on pylons ahead of and below the wing, one or two a side."""
    made, shares = [], [(0.35, 1.0)] if plane.engines == 1 else [(0.32, 0.86), (0.6, 0.8)]
    for share, scale in shares:
        share += plane.engine_shift
        r = 0.037 * plane.engine_size * scale
        wing, edge = plane.wing_point(share), plane.leading_edge(share)
        centre = edge + [0, -2.0 * r, -1.35 * r - 0.006]
        length = 0.55 * plane.wing_chord(share) + 0.6 * r
        lower = centre + [0, 0.9 * r, 0.6 * r], length, np.pi / 2
        upper = edge + [0, 0.01, 0], min(length, wing[1] - edge[1] + 0.02), np.pi / 2
        pylon = pp.lifting_surface([lower, upper], 0.08, plane.gauge)
        made += parts.mirrored(parts.union([pp.jet(r, 3.2 * r, centre), pylon]))
    return made


def _rear_jets(plane) -> list[Manifold]:
    """Nacelles on stubs beside the rear body; a third one in front of the fin of a trijet."""
    body, r = plane.body, 0.034 * plane.engine_size
    y = 0.17 + plane.engine_shift
    z = body.axis(y + 0.05) + 0.4 * body.half_height(y + 0.05)
    centre = np.array([body.half_width(y) + 1.35 * r, y, z])
    root, chords = (0, y + 0.5 * r, z), (2.2 * r, 2.2 * r)
    stub = pp.panel(root, (1, 0), centre[0] - 0.5 * r, chords, 0, 0.16, plane.gauge)
    made = parts.mirrored(parts.union([pp.jet(r, 3.6 * r, centre), stub]))
    if plane.engines == 2 and plane.tail != "v":
        made.append(pp.jet(0.95 * r, 4.2 * r, (0, 0.27, body.top(0.27) + 0.62 * r)))
    return made


def _wing_propellers(plane) -> list[Manifold]:
    """Slender nacelles through the wing with propellers ahead of it, one or two a side."""
    tip = (0.1 if plane.engines == 1 else 0.082) * plane.engine_size
    first = plane.body.radius + tip + 0.025
    places = [first] if plane.engines == 1 else [first, first + 2 * tip + 0.025]
    made, r, place = [], 0.26 * tip, (0, -0.088, 0)
    turning = parts.union(pp.propeller(tip, 0.56 * r, plane.blades + 1, plane.gauge, place, plane.blade_turn))
    for x in places:
        share = x / plane.semi_span
        centre, chord = plane.leading_edge(share) + [0, 0, -0.35 * r], plane.wing_chord(share)
        shape = [(0.62, -0.085), (0.85, -0.075), (1, -0.04)]
        shape += [(1, 0.4 * chord), (0.7, chord), (0.25, 1.3 * chord)]
        nacelle = pp.body_of_revolution(shape, centre, r)
        # Joined before they are mirrored: half the booleans.
        made += parts.mirrored(parts.union([nacelle, turning.translate(centre)]))
    return made


def _nose_propeller(plane) -> list[Manifold]:
    """A spinner and blades on the nose; braces under a high wing."""
    body, tip = plane.body, 0.125 * plane.engine_size
    hub = np.array([0, -0.507, body.axis(-0.5)])
    made = pp.propeller(tip, 0.36 * body.radius, plane.blades, plane.gauge, hub, plane.blade_turn)
    if plane.mount == "high":
        foot = plane.wing_point(0, 0.35) * [0, 1, 0] + [0.7 * body.radius, 0, -0.55 * body.half_height(0)]
        made += parts.mirrored(parts.bar(foot, plane.wing_point(0.5, 0.35), 0.7 * plane.gauge))
    return made


def _afterburners(plane) -> list[Manifold]:
    """Open nozzles at the tail, one or two, fed by intakes on the body's sides."""
    body = plane.body
    r = (0.8 if plane.engines == 1 else 0.58) * body.half_width(0.5) * plane.engine_size
    made, z = [], body.axis(0.5)
    for x in [0.0] if plane.engines == 1 else [-0.92 * r, 0.92 * r]:
        shape = [(1.12, 0.38), (1.12, 0.51), (0.92, 0.56), (0.64, 0.56), (0.54, 0.525), (0.1, 0.525)]
        made.append(pp.body_of_revolution(shape, (x, 0, z), r))
    return made + parts.mirrored(_intake(plane))


def _intake(plane) -> Manifold:
    """A box beside the body, raked and open in front, that fades towards the tail."""
    wide, tall = 0.62 * plane.body.radius, 0.85 * plane.body.half_height(0)
    front = -0.16 + plane.engine_shift
    unit, rings, wall = pp.superellipse(24, 5.0), [], 1.2 * plane.gauge
    mouth = [(front + 0.035, 0.92, 0.02, wall), (front, 0.92, 0.02, wall), (front, 0.92, 0.02, 0.0)]
    for y, share, rake, shrink in [*mouth, (front + 0.12, 1, 0, 0), (0.2, 0.95, 0, 0), (0.44, 0.3, 0, 0)]:
        x = plane.body.radius * (0.62 + 0.38 * share) + (share * wide - shrink) * unit[:, 0]
        z = -0.1 * tall + (share * tall - shrink) * unit[:, 1]
        rings.append(np.column_stack([x, y - rake * unit[:, 1], z]))
    return parts.loft(rings)


def gear(plane) -> list[Manifold]:
    """Struts and wheels: a pair under the wing or the body, and a third at the nose or the tail."""
    if plane.gear == "retracted":
        return []
    body, b, r = plane.body, plane.base, plane.base.wheel
    ground = -body.half_height(0) - b.clearance
    if plane.kind == "glider":
        return [pp.wheel(r, 2.4 * plane.gauge, (0, plane.wing_point(0)[1] - 0.03, ground + r))]
    tail_wheel = plane.gear == "taildragger" and plane.kind in ("single", "turboprop")
    y = plane.wing_point(0, 0.12 if tail_wheel else 0.62)[1]
    under_body = plane.mount == "high" or plane.kind == "fighter"
    x = body.radius * 1.5 if under_body else max(0.24 * plane.semi_span, body.radius + 0.03)
    share = 0.3 if under_body else x / plane.semi_span
    top = np.array([0.3 * body.radius, y, -0.4 * body.half_height(0)])
    if not under_body:
        top = plane.leading_edge(share)
        y = top[1] = np.clip(y, *(plane.wing_point(share, a)[1] for a in (0.25, 0.7)))
    made = parts.mirrored(parts.union(_leg(plane, top, np.array([x, y, ground + r]), r)))
    if tail_wheel:
        y = 0.44
        foot = np.array([0, y + 0.015, body.axis(y) - body.half_height(y) - 0.7 * r])
        return made + _leg(plane, np.array([0, y, body.axis(y)]), foot, 0.5 * r)
    y = -0.5 + body.nose * (0.9 if plane.kind != "fighter" else 0.8)
    return made + _leg(plane, np.array([0, y, body.axis(y)]), np.array([0, y, ground + 0.85 * r]), 0.85 * r)


def _leg(plane, top: np.ndarray, axle: np.ndarray, radius: float) -> list[Manifold]:
    """One strut with a wheel, two wheels under an airliner, a fairing over a light aircraft's."""
    thick = 0.62 * plane.gauge
    made = [parts.bar(top, axle, 1.15 * thick, thick)]
    if plane.kind == "airliner":
        offset = np.array([0.9 * radius, 0, 0])
        made.append(parts.bar(axle - offset, axle + offset, thick))
        return made + [pp.wheel(radius, 0.8 * radius, axle + s * offset) for s in (-1, 1)]
    made.append(pp.wheel(radius, max(0.7 * radius, 1.8 * plane.gauge), axle))
    if plane.kind == "single" and plane.spats:
        radii = 0.55 * radius + 0.004, 1.7 * radius, 0.7 * radius
        made.append(parts.ellipsoid(radii, axle + [0, 0.3 * radius, 0.3 * radius], 16))
    return made
