"""The reconstruction of one scan: code, mesh and verdict, as NAME.ply and NAME.json and a line of a table."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

from sdfhub.whole_file import write_whole

Verdict = Literal["fitted", "doubtful", "unjudged", "failed"]


@dataclass(frozen=True)
class Limits:
    """What residual and doubt of a fit may be at most, for it not to be doubtful."""

    residual: float
    doubt: float


@dataclass(frozen=True)
class Result:
    """The reconstruction of one scan.

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
    verdict: Verdict = "failed"
    reason: str = ""
    code: tuple[float, ...] = ()
    frame: tuple[tuple[float, ...], ...] = ()
    mesh: str | None = None

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
    width = max(len("scan"), *(len(result.name) for result in results)) + 2
    lines = [
        f"{'scan':<{width}}{'verdict':<10}{'residual':>10}{'at most':>9}{'doubt':>11}{'at most':>11}  "
        "judged as (numbers times 10^3)"
    ]
    for result in results:
        residual, doubt = (result.limits.residual, result.limits.doubt) if result.limits else (None, None)
        numbers = (result.residual, 10), (residual, 9), (result.doubt, 11), (doubt, 11)
        cells = [f"{'' if value is None else format(value * 1e3, '.3f'):>{size}}" for value, size in numbers]
        reason = f"; {result.reason}" if result.reason and result.verdict != "failed" else ""
        lines.append(f"{result.name:<{width}}{result.verdict:<10}{''.join(cells)}  {result.kind}{reason}")
    return "\n".join(lines)
