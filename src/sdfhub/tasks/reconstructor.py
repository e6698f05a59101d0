"""Scans through a trained space: fitted, meshed in their own frames, judged, written one by one."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from torch import Tensor
from tqdm import tqdm

from sdfhub.errors import SdfhubError
from sdfhub.geometry.mesh_file import write_mesh
from sdfhub.geometry.mesher import Mesh
from sdfhub.latent.prior import Normal
from sdfhub.latent.reconstruction import Fitted, Method
from sdfhub.latent.similarity import PoseRange
from sdfhub.scans.evidence import Evidence
from sdfhub.scans.scan import read_scan
from sdfhub.scans.target import FrameKind, Target, observed
from sdfhub.space import Space
from sdfhub.tasks.calibration import Alike, Limits
from sdfhub.whole_file import write_whole


@dataclass(frozen=True)
class Reconstructor:
    """A trained space and how scans are fitted in it.

    Args:
        space: where codes are looked for.
        likely: codes of that space.
        method: finds codes and poses.
        evidence: what a scan says.
        frame: of the scans.
        poses: how far the scans' frames may be off; None where they are known.
        resolution: points along an axis of the marching-cubes grid, >= 2.
    """

    space: Space
    likely: Normal
    method: Method
    evidence: Evidence
    frame: FrameKind
    poses: PoseRange | None
    resolution: int

    def target(self, path: Path, sensor: Sequence[float] | None) -> Target:
        """The shape that a file observes; the same file gives the same observation.

        Args:
            path: of a scan.
            sensor: [3] from where a cloud was seen that does not say so itself, in its frame, or None.

        Raises:
            SdfhubError: names the file.
        """
        scan = read_scan(path)
        if sensor is not None and scan.kind in ("bare", "oriented"):
            scan = replace(scan, sensor=np.array(sensor, dtype=np.float64))
        try:
            return observed(scan, self.evidence, self.frame, np.random.default_rng(0))
        except SdfhubError as error:
            raise SdfhubError(f"{path}: {error}") from error

    def fit(self, targets: Sequence[Target]) -> Fitted:
        """Codes, residuals and poses of targets, each found as if it were alone."""
        observations = [each.observation for each in targets]
        try:
            return self.method(self.space.decoder, self.space.codes, observations, self.poses)
        except ValueError as error:
            raise SdfhubError(f"method: {error}") from error

    def judged(self, targets: Sequence[Target]) -> np.ndarray:
        """Residuals and doubts [B, 2] of targets whose shapes nobody asked for."""
        bar = tqdm(targets, desc="calibrating", unit="scan", leave=False, disable=None)
        fits = (self.fit([each]) for each in bar)
        return np.array([(float(fitted.residuals), float(self.doubts(fitted))) for fitted in fits])

    def doubts(self, fitted: Fitted) -> Tensor:
        """[B] residuals, each times the fourth power of one plus how unusual its code is.

        A space can bend to a stranger: little is left then, but the code lies where none of its own do.
        """
        return fitted.residuals * (1 + self.likely.unusual(fitted.codes)) ** 4

    def meshes(self, targets: Sequence[Target], fitted: Fitted) -> Iterator[tuple[Mesh, np.ndarray]]:
        """Meshes in the targets' own frames, and the matrices [4, 4] from the normalised frame to these."""
        for row, mesh in enumerate(self.space.meshes(fitted.codes, self.resolution)):
            matrix = to_scan(targets[row], fitted, row)
            yield (mesh[0] @ matrix[:3, :3].T + matrix[:3, 3], mesh[1]), matrix


def to_scan(target: Target, fitted: Fitted, row: int) -> np.ndarray:
    """[4, 4] float64 matrix from the normalised frame to that of a target's scan."""
    observed_to_scan, pose = np.eye(4), np.eye(4)
    observed_to_scan[:3] = np.column_stack([np.eye(3) / target.scale, target.center])
    if fitted.poses is not None:
        scale, rotation, shift = (part[row].double().cpu().numpy() for part in fitted.poses)
        pose[:3] = np.column_stack([scale * rotation, shift])
    return observed_to_scan @ np.linalg.inv(pose)


@dataclass(frozen=True)
class Found:
    """What was found of one scan.

    Args:
        name: of its files.
        kind: what it was judged as; empty where it failed.
        residual: mean violation of the scan's bounds, normalised units.
        doubt: the same times the fourth power of one plus how unusual its code is.
        limits: what these two may be at most; None where nothing was calibrated.
        verdict: fitted, doubtful, unjudged (not calibrated) or failed.
        reason: of a verdict other than fitted.
        code: [L] numbers.
        frame: rows [4][4] of the matrix from the normalised frame to the scan's.
        mesh: file name; None without a surface.
    """

    name: str
    kind: str = ""
    residual: float | None = None
    doubt: float | None = None
    limits: Limits | None = None
    verdict: Literal["fitted", "doubtful", "unjudged", "failed"] = "failed"
    reason: str = ""
    code: tuple[float, ...] = ()
    frame: tuple[tuple[float, ...], ...] = ()
    mesh: str | None = None

    def judged(self, limits: Limits | None, is_near: bool) -> "Found":
        """The same with a verdict.

        Args:
            limits: for its kind of scan; None where nothing was calibrated.
            is_near: whether its pose lies within the range of poses.
        """
        if self.mesh is None:
            verdict, reason = "doubtful", "the field has no surface"
        elif not is_near:
            verdict, reason = "doubtful", "no pose within poses.scale, poses.tilt and poses.shift was found"
        elif limits is None:
            verdict, reason = "unjudged", "nothing was calibrated"
        else:
            reason = self._beyond(limits)
            verdict = "doubtful" if reason else "fitted"
        return replace(self, limits=limits, verdict=verdict, reason=reason)

    def _beyond(self, limits: Limits) -> str:
        """How many times residual and doubt are their limits, where they are more; else nothing."""
        pairs = ("residual", self.residual, limits.residual), ("doubt", self.doubt, limits.doubt)
        return ", ".join(
            f"{name} {has / most:.2f} x its limit" for name, has, most in pairs if not has <= most
        )


def reconstruct_targets(
    how: Reconstructor,
    targets: dict[str, Target],
    limits: dict[Alike, Limits],
    out: Path,
    together: int,
) -> Iterator[Found]:
    """Fits and meshes targets by name and writes NAME.ply and NAME.json of each, as they are found.

    One that fails does not stop the others.

    Args:
        how: the space.
        targets: by the names of their files.
        limits: by kind of scan.
        out: folder.
        together: targets fitted side by side.
    """
    names = list(targets)
    for first in range(0, len(names), together):
        group = names[first : first + together]
        try:
            yield from _reconstruct_group(how, {name: targets[name] for name in group}, limits, out)
        except SdfhubError as error:
            if len(group) == 1:
                yield Found(group[0], reason=str(error))
            else:  # which of them it is shows when each is alone
                yield from reconstruct_targets(how, {name: targets[name] for name in group}, limits, out, 1)


def _reconstruct_group(
    how: Reconstructor, group: dict[str, Target], limits: dict[Alike, Limits], out: Path
) -> list[Found]:
    targets, found = list(group.values()), []
    fitted = how.fit(targets)
    doubts = how.doubts(fitted).tolist()
    near = how.poses.holds(fitted.poses).tolist() if fitted.poses else [True] * len(group)
    for row, (mesh, matrix) in enumerate(how.meshes(targets, fitted)):
        name, kind = list(group)[row], Alike.to(targets[row])
        result = Found(
            name,
            kind=str(kind),
            residual=float(fitted.residuals[row]),
            doubt=doubts[row],
            code=tuple(fitted.codes[row].tolist()),
            frame=tuple(map(tuple, matrix.tolist())),
            mesh=f"{name}.ply" if len(mesh[1]) else None,
        )
        found.append(result.judged(limits.get(kind), near[row]))
        _write(found[-1], mesh, out)
    return found


def _write(found: Found, mesh: Mesh, out: Path) -> None:
    """The mesh first, what is said of it last."""
    write_mesh(*mesh, out / f"{found.name}.ply")
    write_found(found, out)


def write_found(found: Found, out: Path) -> None:
    """What was found of a scan, or why nothing was, as NAME.json."""
    write_whole(out / f"{found.name}.json", json.dumps(asdict(found), indent=1))


def table(results: Sequence[Found]) -> str:
    """A line a scan: verdict, residual and doubt beside their limits, times 10^3, what it was judged as."""
    width = max(len("scan"), *(len(each.name) for each in results)) + 2
    head = f"{'residual':>10}{'at most':>9}{'doubt':>11}{'at most':>11}  judged as (numbers times 10^3)"
    lines = [f"{'scan':<{width}}{'verdict':<10}{head}"]
    for each in results:
        most = each.limits
        limits = (most.residual, most.doubt) if most else (None, None)
        numbers = ((each.residual, 10), (limits[0], 9), (each.doubt, 11), (limits[1], 11))
        cells = [f"{'' if value is None else format(value * 1e3, '.3f'):>{size}}" for value, size in numbers]
        why = f"; {each.reason}" if each.reason and each.verdict != "failed" else ""
        lines.append(f"{each.name:<{width}}{each.verdict:<10}{''.join(cells)}  {each.kind}{why}")
    return "\n".join(lines)
