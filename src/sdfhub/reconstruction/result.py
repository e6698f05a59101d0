"""The reconstruction of one scan: code, mesh and verdict, as NAME.ply and NAME.json and a line of a table."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

from tabulate import tabulate

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

    def write(self, out: Path) -> None:
        """Writes NAME.json into a folder."""
        write_whole(out / f"{self.name}.json", json.dumps(asdict(self), indent=1))


def is_result(path: Path) -> bool:
    """Whether a mesh is the result of an earlier command: the JSON beside it says so."""
    try:
        content = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(content, dict) and "verdict" in content and content.get("mesh") == path.name


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
