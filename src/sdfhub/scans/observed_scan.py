"""A scan in the frame of a shape space: the observation that is fitted, and the way back."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from sdfhub.data.preparation.sampling import prepare_mesh
from sdfhub.data.preparation.settings import Preparation
from sdfhub.data.store.stored_shape import StoredShape, signed_samples
from sdfhub.errors import SdfhubError
from sdfhub.scans.evidence import Evidence
from sdfhub.scans.scan import LEAST, Scan
from sdfhub.shapes import NORMALIZED, Frame, Observation

ScanFrame = Frame | Literal["shape", "unknown"]  # a known one, as the scan's own box tells, or nobody knows

MOST = 2**16  # points of a cloud that are used: a random draw of more
LARGEST, SMALLEST = 1.2, 0.2  # distance of the farthest point from the origin, normalised frame
FAR = 2.5  # the same of signed samples, which are also drawn around the shape


@dataclass(frozen=True)
class ObservedScan:
    """What a scan says of the shape behind it."""

    kind: str  # samples, oriented, bare or view
    count: int  # points of the scan
    observation: Observation  # in the normalised frame, or near it where that is unknown
    frame: Frame  # where the observation's frame lies in the scan's


def observe(scan: Scan, evidence: Evidence, frame: ScanFrame, rng: np.random.Generator) -> ObservedScan:
    """What a scan says of the shape behind it.

    A mesh becomes signed samples; these lie in the normalised frame unless another known one is given.
    """
    if scan.faces is not None:
        return _observe_mesh(scan, scan.faces, evidence, frame, rng)
    if scan.kind == "view" and frame == "shape":
        raise SdfhubError("one view shows no whole box; give frame=normalised, or frame=unknown to find it")
    own = None if scan.sdf is None else NORMALIZED
    lies = frame if isinstance(frame, Frame) else own or _box_frame(scan.points)
    points = lies.to_normalized(scan.points)
    _refuse_misplaced(points, LARGEST if scan.sdf is None else FAR)
    if np.ptp(points, axis=0).max() < SMALLEST:
        raise SdfhubError("its points all lie in one place")
    if scan.sdf is not None:
        observation = evidence.of_samples(points, scan.sdf * lies.scale, rng)
        lies = scan.frame if scan.frame is not None and lies is NORMALIZED else lies
        return ObservedScan("samples", len(points), observation, lies)
    rows = np.sort(np.unique(points, axis=0, return_index=True)[1])  # repeated ones look infinitely dense
    if len(rows) < LEAST:
        raise SdfhubError(f"holds {len(rows)} different points; at least {LEAST} are needed to know a shape")
    rows = rows[rng.permutation(len(rows))[:MOST]] if len(rows) > MOST else rows
    points, normals = points[rows], None if scan.normals is None else scan.normals[rows]
    if scan.sensor is None:
        observation = evidence.of_cloud(points, normals, rng)
    else:
        observation = evidence.of_view(points, normals, lies.to_normalized(scan.sensor), rng)
    return ObservedScan(scan.kind, len(points), observation, lies)


def _observe_mesh(scan: Scan, faces, evidence: Evidence, frame: ScanFrame, rng) -> ObservedScan:
    if isinstance(frame, Frame):
        _refuse_misplaced(frame.to_normalized(scan.points), LARGEST)
    preparation = Preparation(samples=max(2 * evidence.samples, 10_000), surface_points=0)
    prepared = prepare_mesh((scan.points, faces), preparation)
    points, sdf, own = prepared.points.astype(np.float64), prepared.sdf.astype(np.float64), prepared.frame
    frame = frame if isinstance(frame, Frame) else own
    samples = Scan(own.to_source(points), sdf=sdf / own.scale)
    return replace(observe(samples, evidence, frame, rng), count=len(scan.points))


def observations_of(shapes: Sequence[StoredShape], samples: int | None, seeds: Sequence[int]) -> list:
    """Observations of so many signed samples of each shape by a seed of its own; None for all samples."""
    pairs = zip(shapes, map(np.random.default_rng, seeds), strict=True)
    drawn = [signed_samples(shape, samples, rng) for shape, rng in pairs]
    return [Observation.of_samples(rows[:, :3], rows[:, 3]) for rows in drawn]


def _refuse_misplaced(points: np.ndarray, largest: float) -> None:
    reach = float(np.linalg.norm(points, axis=1).max())
    if not SMALLEST <= reach <= largest:
        advice = "; give frame=shape if it is whole" if largest == LARGEST else ""
        raise SdfhubError(f"reaches {reach:.3g} from the origin, the normalised frame about 1{advice}")


def _box_frame(points: np.ndarray) -> Frame:
    """The frame by which the box of points [N, 3] comes to 0 and the farthest to 1 / 1.03."""
    half = points.max(axis=0) / 2 - points.min(axis=0) / 2
    if half.min() >= 1e-3 * half.max() > 0:
        with suppress(ValueError):
            return Frame.around(points)[0]
    raise SdfhubError(f"its extents are {2 * half}: no shape with an inside has such")
