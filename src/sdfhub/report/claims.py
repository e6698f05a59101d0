"""Which claims hold in a group of rows, with the figures behind each verdict."""

from dataclasses import dataclass
from typing import Literal

from sdfhub.report.paper import CLAIMS, TRAINED_ON, Below, Claim
from sdfhub.report.results import NOISE
from sdfhub.report.rows import THOUSANDFOLD, Estimate, Group, duration

FAR = 1e-2
"""Chamfer distance of known shapes from which on a field has not learnt them: .07 away."""


@dataclass(frozen=True)
class Verdict:
    """A claim as it stands.

    Args:
        claim: what was claimed.
        state: `not tested` where a deciding figure is missing or differs by the noise of sampling alone.
        figures: the figures behind the verdict, or what is missing, one comparison each.
        within_noise: confidence intervals over seeds overlap in comparisons without which the verdict falls.
        one_seed: a comparison without which the verdict falls has a side of one seed, whose noise is unknown.
    """

    claim: Claim
    state: Literal["holds", "does not hold", "not tested"]
    figures: list[str]
    within_noise: bool = False
    one_seed: bool = False

    @property
    def doubt(self) -> str:
        """What the verdict may owe to chance; empty where seeds bear it out, or nothing was tested."""
        return "within seed noise" if self.within_noise else "one seed" if self.one_seed else ""

    @property
    def told(self) -> str:
        """The verdict in words, with its doubt."""
        return f"{self.state} ({self.doubt})" if self.doubt else self.state


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
    # True, False, or None where it cannot be said
    known = [
        {True: False, False: True, None: None}[overlap] if claim.apart and holds else holds
        for holds, overlap, _ in outcomes
    ]
    if claim.needs == "all":
        state = False if False in known else None if None in known else True
    else:
        state = True if True in known else None if None in known else False
    words = {True: "holds", False: "does not hold", None: "not tested"}[state]
    decisive = [overlap for (_, overlap, _), one in zip(outcomes, known, strict=True) if one is state]
    # one comparison alone decides that not all hold, or that any does: then only if none is clear it is noise
    told = any if (claim.needs == "all") is state else all
    noise = state is not None and not claim.apart and bool(decisive) and told(o is True for o in decisive)
    unclear = (None,) if claim.apart else (None, True)
    unknown = state is not None and bool(decisive) and told(o in unclear for o in decisive)
    figures = list(dict.fromkeys(text for *_, text in outcomes))
    return Verdict(claim, words, figures + _other_size(claim, group), noise, unknown and not noise)


def _other_size(claim: Claim, group: Group) -> list[str]:
    """That the paper's table, which the claim is about, has another number of shapes."""
    trained_on = {cell.scores.trained_on for row in group.rows for cell in row.done}
    papers = TRAINED_ON.get(claim.sweep)
    if papers is None or not trained_on or trained_on == {papers}:
        return []
    ours = " to ".join(map(str, dict.fromkeys((min(trained_on), max(trained_on)))))
    return [f"on {ours} shapes, the paper's table on {papers}"]


def _compared(below: Below, group: Group) -> tuple[bool | None, bool | None, str]:
    """Whether the comparison holds, if intervals overlap (None: cannot be said), the figures in words."""
    sides = []
    for name in (below.left, below.right):
        row = group.row(*name)
        value = row.estimate(below.quantity, below.role) if row else None
        if value is None:
            of_method = group.rows_of(*name)
            shown = row.label if row else f"{name[0]}, normals {name[1]}"
            why = "several rows" if len(of_method) > 1 else "no figure of" if row else "no such row"
            return None, False, f"{why}: {shown}"
        if below.quantity in THOUSANDFOLD and not row.has_surfaces(below.role):
            return None, False, f"no shape has a surface: {row.label}"
        sides.append((row.label, value))
    (left, a), (right, b) = sides
    if below.quantity in THOUSANDFOLD and below.role == "known" and min(a.mean, b.mean) > FAR:
        return None, False, f"neither is near its shapes: {left}, {right}"
    if below.factor != 1 and below.quantity in THOUSANDFOLD and b.mean <= NOISE:
        return None, False, f"no more than noise to take a share of: {right} {_told(b, below.quantity)}"
    limit = "" if below.factor == 1 else f"{below.factor:.2g} x "
    holds = a.mean < below.factor * b.mean
    sign = "<" if holds else "not <"
    what = below.quantity.replace("_", " ") + (" of held-out shapes" if below.role == "held_out" else "")
    text = f"{what}: {left} {_told(a, below.quantity)} {sign} {limit}{right} {_told(b, below.quantity)}"
    if below.quantity in THOUSANDFOLD and abs(a.mean - below.factor * b.mean) < NOISE:
        return None, False, f"{text} (by less than the noise of sampling)"
    overlap = False if below.quantity == "parameters" else _overlap(a, b, below.factor)
    return holds, overlap, text + (" (intervals overlap)" if overlap else "")


def _overlap(a: Estimate, b: Estimate, factor: float) -> bool | None:
    if a.half_width is None or b.half_width is None:
        return None
    return abs(a.mean - factor * b.mean) < a.half_width + factor * b.half_width


def _told(value: Estimate, quantity: str) -> str:
    scaled = value.mean * 1e3 if quantity in THOUSANDFOLD else value.mean
    if quantity == "parameters":
        return f"{scaled:,.0f}"
    return duration(scaled) if quantity == "seconds" else f"{scaled:.4f}"
