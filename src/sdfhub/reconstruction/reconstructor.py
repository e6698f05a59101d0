"""Scans through a trained space: observed, fitted, meshed in their own frames, judged, written."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from tabulate import tabulate
from torch import Tensor

from sdfhub.errors import SdfhubError
from sdfhub.geometry.mesh_file import write_mesh
from sdfhub.latent.fitting import Fit, Fitted
from sdfhub.latent.similarity import PoseRange
from sdfhub.scans.evidence import Evidence
from sdfhub.scans.observed_scan import ObservedScan, ScanFrame, observe
from sdfhub.scans.scan import read_scan
from sdfhub.scans.simulated import ScanKind
from sdfhub.shapes import Mesh
from sdfhub.space import Space
from sdfhub.whole_file import write_whole

Verdict = Literal["fitted", "doubtful", "unjudged", "failed"]


@dataclass(frozen=True)
class Limits:
    """What residual and doubt of a fit may be at most, for it not to be doubtful."""

    residual: float
    doubt: float


@dataclass(frozen=True)
class Result:
    """The reconstruction of one scan."""

    name: str  # of its files
    kind: str = ""  # what it was judged as; empty where it failed
    residual: float | None = None  # mean violation of the scan's bounds, normalised units
    doubt: float | None = None  # the same times the fourth power of one plus how unusual its code is
    limits: Limits | None = None  # what these two may be at most; None where nothing was calibrated
    verdict: Verdict = "failed"
    reason: str = ""  # of a verdict other than fitted
    code: tuple[float, ...] = ()  # [L]
    frame: tuple[tuple[float, ...], ...] = ()  # matrix [4][4] from the normalised frame to the scan's
    mesh: str | None = None  # file name; None without a surface

    def write(self, out: Path) -> None:
        write_whole(out / f"{self.name}.json", json.dumps(asdict(self), indent=1))

    def judged(self, limits: Limits | None, is_near: bool) -> "Result":
        """The same with a verdict; `is_near` tells whether its pose lies within the range of poses."""
        verdict: Verdict = "doubtful"
        if self.mesh is None:
            reason = "the field has no surface"
        elif not is_near:
            reason = "no pose within poses.scale, poses.tilt and poses.shift was found"
        elif limits is None or self.residual is None or self.doubt is None:
            verdict, reason = "unjudged", "nothing was calibrated"
        else:
            shares = {"residual": self.residual / limits.residual, "doubt": self.doubt / limits.doubt}
            reason = ", ".join(f"{name} {x:.2f} x its limit" for name, x in shares.items() if not x <= 1)
            verdict = "doubtful" if reason else "fitted"
        return replace(self, limits=limits, verdict=verdict, reason=reason)


@dataclass(frozen=True)
class Reconstructor:
    """A trained space and how scans are fitted in it."""

    space: Space
    fit: Fit
    evidence: Evidence
    frame: ScanFrame
    poses: PoseRange | None  # how far the scans' frames may be off; None where they are known
    resolution: int  # points along an axis of the marching-cubes grid, >= 2

    def read(self, path: Path, sensor: Sequence[float] | None) -> ObservedScan:
        """The scan in a file, observed; `sensor` [3] is where a cloud was seen from that does not say so."""
        scan = read_scan(path)
        if sensor is not None and scan.kind in ("bare", "oriented"):
            scan = replace(scan, sensor=np.array(sensor, dtype=np.float64))
        try:
            return observe(scan, self.evidence, self.frame, np.random.default_rng(0))
        except SdfhubError as error:
            raise SdfhubError(f"{path}: {error}") from error

    def fitted(self, scans: Sequence[ObservedScan]) -> Fitted:
        """Codes, residuals and poses of scans, each found as if it were alone."""
        observations = [scan.observation for scan in scans]
        return self.fit(self.space.decoder, self.space.codes, observations, self.space.delta, self.poses)

    def doubts(self, fitted: Fitted) -> Tensor:
        """[B] residuals * (1 + unusual)^4: the residual of a stranger may be small, its code is far off."""
        return fitted.residuals * (1 + self.space.unusual(fitted.codes)) ** 4

    def meshes(self, scans: Sequence[ObservedScan], fitted: Fitted) -> Iterator[tuple[Mesh, np.ndarray]]:
        """Meshes in the scans' own frames, and the matrices [4, 4] from the normalised frame to these."""
        for row, mesh in enumerate(self.space.meshes(fitted.codes, self.resolution)):
            observed_to_scan, pose = np.eye(4), np.eye(4)
            frame = scans[row].frame
            observed_to_scan[:3] = np.column_stack([np.eye(3) / frame.scale, frame.center])
            if fitted.poses is not None:
                scale, rotation, shift = (part[row].double().cpu().numpy() for part in fitted.poses)
                pose[:3] = np.column_stack([scale * rotation, shift])
            matrix = observed_to_scan @ np.linalg.inv(pose)
            yield Mesh(mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3], mesh.faces), matrix

    def reconstruct(
        self, scans: Mapping[str, ObservedScan], limits: Mapping[ScanKind, Limits], out: Path, together: int
    ) -> Iterator[Result]:
        """Fits scans by name, `together` at once, and writes NAME.ply and NAME.json; failures stop none."""
        names = list(scans)
        for first in range(0, len(names), together):
            group = {name: scans[name] for name in names[first : first + together]}
            try:
                yield from self._reconstruct_group(group, limits, out)
            except SdfhubError as error:
                if len(group) == 1:
                    yield Result(names[first], reason=str(error))
                else:  # alone, each shows whether it is the one that fails
                    yield from self.reconstruct(group, limits, out, 1)

    def _reconstruct_group(self, group: Mapping, limits: Mapping, out: Path) -> list[Result]:
        scans, results = list(group.values()), []
        fitted = self.fitted(scans)
        doubts = self.doubts(fitted)
        near = self.poses.holds(fitted.poses) if self.poses and fitted.poses else [True] * len(group)
        for row, (mesh, matrix) in enumerate(self.meshes(scans, fitted)):
            name, kind = list(group)[row], ScanKind.of(scans[row])
            residual, doubt = float(fitted.residuals[row]), float(doubts[row])
            code, frame = tuple(fitted.codes[row].tolist()), tuple(map(tuple, matrix.tolist()))
            file = f"{name}.ply" if len(mesh.faces) else None
            result = Result(name, str(kind), residual, doubt, code=code, frame=frame, mesh=file)
            results.append(result.judged(limits.get(kind), bool(near[row])))
            write_mesh(*mesh, out / f"{name}.ply")  # before: a result is whole when it is described
            results[-1].write(out)
        return results


def is_result(path: Path) -> bool:
    """Whether a mesh is the result of an earlier command: the JSON beside it says so."""
    beside = path.with_suffix(".json")
    words = '"verdict": ', f'"mesh": {json.dumps(path.name)}'
    return beside.is_file() and all(word in beside.read_text("utf-8", "replace") for word in words)


def table(results: Sequence[Result]) -> str:
    """A line a scan: verdict, residual and doubt beside their limits, times 10^3, what it was judged as."""
    lines = [["scan", "verdict", "residual x10^3", "limit", "doubt x10^3", "limit", "judged as"]]
    for result in results:
        limits = asdict(result.limits) if result.limits else {}
        numbers = result.residual, limits.get("residual"), result.doubt, limits.get("doubt")
        cells = [f"{1e3 * value:.3f}" if value is not None else "" for value in numbers]
        reason = f"; {result.reason}" if result.reason and result.verdict != "failed" else ""
        lines.append([result.name, result.verdict, *cells, result.kind + reason])
    return tabulate(lines, headers="firstrow", disable_numparse=True)
