"""A scan in the frame of a shape space: what is fitted, and the way back to the scan's own frame."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from sdfhub.data.preparation.sampling import prepare_mesh
from sdfhub.data.preparation.settings import Preparation
from sdfhub.errors import SdfhubError
from sdfhub.scans.evidence import Evidence
from sdfhub.scans.scan import LEAST, Scan
from sdfhub.shapes import RADIUS, Observation

FrameKind = Literal["shape", "normalised", "unknown"]
"""How a scan lies to the normalised frame: as its own bounding box tells, in it, or nobody knows."""

MOST = 2**16
"""Points of a cloud that are used: a random draw of more."""

LARGEST, SMALLEST = 1.2, 0.2
"""Distance of the farthest point from the origin that a scan in the normalised frame may have."""

FAR = 2.5
"""The same of signed samples, which are also drawn around the shape."""

WHOLE = "give frame=shape if it is whole"


@dataclass(frozen=True)
class Target:
    """An observed shape.

    Args:
        kind: samples, oriented, bare or view.
        count: points of the scan.
        observation: in the normalised frame, or near it where that is unknown.
        center: [3] float64, and scale: `scan = observed / scale + center`.
        scale: as above, > 0.
    """

    kind: str
    count: int
    observation: Observation
    center: np.ndarray
    scale: float


def observed(scan: Scan, evidence: Evidence, frame: FrameKind, rng: np.random.Generator) -> Target:
    """What a scan says of the shape behind it.

    Signed samples lie in the normalised frame as they are; a mesh becomes such samples. A view shows no
    whole bounding box, so that its frame must be normalised or unknown.

    Raises:
        SdfhubError: the scan does not fit the frame; RejectedMesh where its mesh cannot be trusted.
    """
    if scan.faces is not None:
        if frame == "normalised":
            refuse_misplaced(scan.points, LARGEST, WHOLE)
        preparation = Preparation(samples=max(4 * evidence.rows, 10_000), surface_points=0)
        prepared = prepare_mesh((scan.points, scan.faces), preparation)
        own = Scan(prepared.points.astype(np.float64), sdf=prepared.sdf.astype(np.float64))
        own = replace(own, center=prepared.center, scale=prepared.scale)
        if frame == "normalised":  # samples as the mesh lies, not as it would be normalised
            own = Scan(own.points / own.scale + own.center, sdf=own.sdf / own.scale)
        return replace(observed(own, evidence, "normalised", rng), count=len(scan.points))
    if scan.kind == "view" and frame == "shape":
        raise SdfhubError("one view shows no whole box; give frame=normalised, or frame=unknown to find it")
    center, scale = np.zeros(3), 1.0
    if scan.sdf is None and frame != "normalised":
        center, scale = box_frame(scan.points)
    points = (scan.points - center) * scale
    if scan.sdf is None:
        refuse_misplaced(points, LARGEST, WHOLE)
    else:
        refuse_misplaced(points, FAR, "signed samples belong there")
    if np.ptp(points, axis=0).max() < SMALLEST:
        raise SdfhubError("its points all lie in one place")
    if scan.sdf is not None:
        observation = evidence.of_samples(points, scan.sdf, rng)
        center, scale = (scan.center, scan.scale) if scan.center is not None else (center, scale)
    elif scan.sensor is not None:
        points, normals = thinned(*distinct(points, scan.normals), rng)
        observation = evidence.of_view(points, normals, (scan.sensor - center) * scale, rng)
    else:
        points, normals = thinned(*distinct(points, scan.normals), rng)
        observation = evidence.of_cloud(points, normals, rng)
    return Target("samples" if scan.sdf is not None else scan.kind, len(points), observation, center, scale)


def refuse_misplaced(points: np.ndarray, largest: float, advice: str) -> None:
    """Refuses points [N, 3] of another frame than the normalised one.

    Raises:
        SdfhubError: the farthest lies nearer to the origin than SMALLEST or farther than `largest`.
    """
    reach = float(np.linalg.norm(points, axis=1).max())
    if not SMALLEST <= reach <= largest:
        raise SdfhubError(f"reaches {reach:.3g} from the origin, the normalised frame about 1; {advice}")


def distinct(points: np.ndarray, normals: np.ndarray | None) -> tuple[np.ndarray, np.ndarray | None]:
    """Each place of points [N, 3] once, with its first normal: repeated ones would look infinitely dense.

    Raises:
        SdfhubError: too few are left.
    """
    rows = np.sort(np.unique(points, axis=0, return_index=True)[1])
    if len(rows) < LEAST:
        raise SdfhubError(f"holds {len(rows)} different points; at least {LEAST} are needed to know a shape")
    return points[rows], None if normals is None else normals[rows]


def thinned(
    points: np.ndarray, normals: np.ndarray | None, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray | None]:
    """At most MOST of the points [N, 3] and of their normals."""
    if len(points) <= MOST:
        return points, normals
    kept = rng.permutation(len(points))[:MOST]
    return points[kept], None if normals is None else normals[kept]


def box_frame(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre [3] and scale by which the box of points [N, 3] comes to 0 and the farthest to 1 / 1.03.

    Raises:
        SdfhubError: they lie in one place, on a line or in a plane, or too far out to be measured.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    half = high / 2 - low / 2
    center = low + half
    farthest = half.max() * np.linalg.norm((points - center) / max(half.max(), 1e-300), axis=1).max()
    if not np.isfinite(farthest) or half.max() <= 0 or half.min() < 1e-3 * half.max():
        raise SdfhubError(f"its extents are {2 * half}: no shape with an inside has such")
    return center, float(RADIUS / farthest)
