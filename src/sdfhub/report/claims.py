"""Which claims hold in a group of rows, with the figures behind each verdict."""

from dataclasses import dataclass
from typing import Literal

from sdfhub.report.paper import CLAIMS, Below, Claim
from sdfhub.report.results import NOISE
from sdfhub.report.rows import THOUSANDFOLD, Estimate, Group, duration


@dataclass(frozen=True)
class Verdict:
    """A claim as it stands.

    Args:
        claim: what was claimed.
        state: `not tested` where a figure that could decide it is missing.
        figures: the figures behind the verdict, or what is missing, one comparison each.
        within_noise: confidence intervals over seeds overlap in comparisons without which the verdict falls.
    """

    claim: Claim
    state: Literal["holds", "does not hold", "not tested"]
    figures: list[str]
    within_noise: bool = False

    @property
    def told(self) -> str:
        """The verdict in words, with its doubt."""
        return self.state + (" (within seed noise)" if self.within_noise else "")


def verdicts(group: Group) -> list[Verdict]:
    """Every claim, judged by a group of rows."""
    return [_verdict(claim, group) for claim in CLAIMS]


def _verdict(claim: Claim, group: Group) -> Verdict:
    sweep = group.choices.get("sweeps", "")
    if not claim.rule:
        return Verdict(claim, "not tested", [])
    if sweep == "smoke":
        return Verdict(claim, "not tested", ["sweeps=smoke trains for seconds"])
    if claim.sweep and claim.sweep != sweep:
        return Verdict(claim, "not tested", [f"tested by sweeps={claim.sweep}"])
    outcomes = [_compared(below, group) for below in claim.rule]
    known = [holds if not (claim.apart and overlap) else False for holds, overlap, _ in outcomes]
    if claim.needs == "all":
        state = False if False in known else None if None in known else True
    else:
        state = True if True in known else None if None in known else False
    words = {True: "holds", False: "does not hold", None: "not tested"}[state]
    decisive = [overlap for (_, overlap, _), one in zip(outcomes, known, strict=True) if one is state]
    # one comparison alone decides that not all hold, or that any does: then only if none is clear it is noise
    told = any if (claim.needs == "all") is state else all
    noise = state is not None and not claim.apart and bool(decisive) and told(decisive)
    return Verdict(claim, words, list(dict.fromkeys(text for *_, text in outcomes)), noise)


def _compared(below: Below, group: Group) -> tuple[bool | None, bool, str]:
    """Whether the comparison holds (None: cannot be said), if intervals overlap, the figures in words."""
    sides = []
    for name in (below.left, below.right):
        row = group.row(*name)
        value = row.estimate(below.quantity, below.role) if row else None
        if value is None:
            of_method = group.rows_of(*name)
            shown = row.label if row else f"{name[0]}, normals {name[1]}"
            return None, False, f"{'several rows' if len(of_method) > 1 else 'no such row'}: {shown}"
        if below.quantity in THOUSANDFOLD and not row.has_surfaces(below.role):
            return None, False, f"no shape has a surface: {row.label}"
        sides.append((row.label, value))
    (left, a), (right, b) = sides
    if below.factor != 1 and below.quantity in THOUSANDFOLD and b.mean <= NOISE:
        return None, False, f"no more than noise to take a share of: {right} {_told(b, below.quantity)}"
    limit = "" if below.factor == 1 else f"{below.factor:.2g} x "
    holds = a.mean < below.factor * b.mean
    sign = "<" if holds else "not <"
    what = below.quantity.replace("_", " ") + (" of held-out shapes" if below.role == "held_out" else "")
    text = f"{what}: {left} {_told(a, below.quantity)} {sign} {limit}{right} {_told(b, below.quantity)}"
    overlap = _overlap(a, b, below.factor)
    return holds, overlap, text + (" (intervals overlap)" if overlap else "")


def _overlap(a: Estimate, b: Estimate, factor: float) -> bool:
    if a.half_width is None or b.half_width is None:
        return False
    return abs(a.mean - factor * b.mean) < a.half_width + factor * b.half_width


def _told(value: Estimate, quantity: str) -> str:
    scaled = value.mean * 1e3 if quantity in THOUSANDFOLD else value.mean
    if quantity == "parameters":
        return f"{scaled:,.0f}"
    return duration(scaled) if quantity == "seconds" else f"{scaled:.4f}"
