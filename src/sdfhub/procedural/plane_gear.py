"""Landing gear of aircraft."""

import numpy as np
from manifold3d import Manifold

from sdfhub.procedural import parts
from sdfhub.procedural import plane_parts as pp


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
