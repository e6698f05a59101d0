"""Which claims of the paper hold in a sweep, with the figures behind each verdict.

    python docs/results/claims.py outputs/sweeps/table_small    # a sweep's folder, or a report's table.csv

Reads what `sdfhub report` wrote and prints the paper's figures beside ours; distances are times 10^3. A claim
is not tested where a row is missing, where two figures differ by no more than the noise of sampling, or where
neither field is near its shapes.

Source: Fan and Musialski, Optimizing 3D Geometry Reconstruction from Implicit Neural Representations, 2024.
"""

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import pandas as pd

from sdfhub.report.tables import duration

RowName = tuple[str, str]
"""Method and normals: the paper's rows carry normals, but for DeepSDF's."""

DEEPSDF, SIREN = ("DeepSDF", "off"), ("SIREN", "on")
FFT_SIREN, FFT_HOSC = ("FFT/SIREN", "on"), ("FFT/HOSC", "on")
HASH_SIREN, HASH_HOSC = ("HASH/SIREN", "on"), ("HASH/HOSC", "on")

PRINTED: dict[str, dict[RowName, tuple[float, float]]] = {
    "table_small": {
        DEEPSDF: (0.2076, 0.0432),
        SIREN: (0.2056, 0.0875),
        FFT_SIREN: (0.1284, 0.0508),
        FFT_HOSC: (0.1142, 0.0474),
    },
    "table_large": {
        DEEPSDF: (0.1037, 0.0422),
        SIREN: (0.1541, 0.0336),
        FFT_SIREN: (0.0493, 0.0249),
        FFT_HOSC: (0.0523, 0.0197),
    },
}
"""Tables 2 and 3: CD mean and median times 10^3."""

TRAINED_ON = {"table_small": 100, "table_large": 1000}
"""Shapes of a category in Tables 2 and 3."""

COSTS: dict[RowName, tuple[float, float]] = {
    DEEPSDF: (1.84e6, 30 * 3600),
    FFT_SIREN: (585e3, 12 * 3600),
    FFT_HOSC: (585e3, 12 * 3600),
}
"""Table 1: parameters and seconds of training; its row "Proposed" stands for both."""

NOISE, FAR = 1e-3, 10.0
"""CD times 10^3: what sampling cannot tell from nothing; from where on a field has not learnt its shapes."""


@dataclass(frozen=True)
class Below:
    """The comparison `quantity(left) < factor * quantity(right)`."""

    quantity: str
    left: RowName
    right: RowName
    factor: float = 1.0
    role: Literal["train", "held_out"] = "train"


@dataclass(frozen=True)
class Claim:
    """A sentence of the paper and the rule that decides whether it holds in a group of rows.

    Args:
        text: the sentence, shortened.
        source: where it stands.
        rule: comparisons; () where no figure of a report can decide it.
        needs: `all` of them, or `any` one.
        sweep: the only sweep that tests it; "" for each that has the rows.
        note: what a reader of the verdict should know.
        apart: confidence intervals that overlap do not bear it out.
    """

    text: str
    source: str
    rule: tuple[Below, ...] = ()
    needs: Literal["all", "any"] = "all"
    sweep: str = ""
    note: str = ""
    apart: bool = False


def beats(
    rows: tuple[RowName, ...], rival: RowName, quantities: tuple[str, ...], factor=1.0
) -> tuple[Below, ...]:
    return tuple(Below(quantity, row, rival, factor) for row in rows for quantity in quantities)


BOTH, FFT_ROWS = ("cd_mean", "cd_median"), (FFT_SIREN, FFT_HOSC)

CLAIMS = (
    Claim(
        "Less than a third of DeepSDF's parameters",
        "section V-A, Table 1",
        beats(FFT_ROWS, DEEPSDF, ("parameters",), 1 / 3),
    ),
    Claim(
        "Less than a third of DeepSDF's training time",
        "section V-A",
        beats(FFT_ROWS, DEEPSDF, ("seconds",), 1 / 3),
        note="its own Table 1 says 12 hours against 30, which is 0.4",
    ),
    Claim(
        "With a sinusoidal activation alone the method falls short of outperforming DeepSDF",
        "section V-C, Table 2",
        (Below("cd_mean", DEEPSDF, SIREN), Below("cd_median", DEEPSDF, SIREN)),
        needs="any",
        sweep="table_small",
        note="falls short: not ahead in both mean and median",
    ),
    Claim(
        "With positional encoding, any periodic activation surpasses DeepSDF in mean CD",
        "section V-C, Table 2",
        beats(FFT_ROWS, DEEPSDF, ("cd_mean",)),
        sweep="table_small",
    ),
    Claim(
        "FFT/HOSC has the lowest mean CD of the small table",
        "Table 2",
        tuple(Below("cd_mean", FFT_HOSC, row) for row in (DEEPSDF, SIREN, FFT_SIREN)),
        sweep="table_small",
    ),
    Claim(
        "DeepSDF has the lowest median CD of the small table",
        "Table 2",
        tuple(Below("cd_median", DEEPSDF, row) for row in (SIREN, FFT_SIREN, FFT_HOSC)),
        sweep="table_small",
    ),
    Claim(
        "On the large set, a periodic activation alone outperforms DeepSDF in median CD but not in mean CD",
        "section V-C, Table 3",
        (Below("cd_median", SIREN, DEEPSDF), Below("cd_mean", DEEPSDF, SIREN)),
        sweep="table_large",
    ),
    Claim(
        "On the large set, positional encoding reduces CD in mean and in median",
        "section V-C, Table 3",
        beats(FFT_ROWS, DEEPSDF, BOTH) + beats(FFT_ROWS, SIREN, BOTH),
        sweep="table_large",
    ),
    Claim(
        "FFT/SIREN has the lowest mean CD of the large table, FFT/HOSC the lowest median CD",
        "Table 3",
        tuple(Below("cd_mean", FFT_SIREN, row) for row in (DEEPSDF, SIREN, FFT_HOSC))
        + tuple(Below("cd_median", FFT_HOSC, row) for row in (DEEPSDF, SIREN, FFT_SIREN)),
        sweep="table_large",
    ),
    Claim(
        "Normals significantly improve the accuracy of SIREN, FFT/SIREN and FFT/HOSC",
        "sections III-D and V-B, Figure 5",
        tuple(
            Below(quantity, (method, "on"), (method, "off"))
            for method in ("SIREN", "FFT/SIREN", "FFT/HOSC")
            for quantity in BOTH
        ),
        note="significantly: intervals over seeds must not overlap, which needs seeds",
        apart=True,
    ),
    Claim(
        "Hash encoding fails to learn the full space of shapes",
        "sections III-C and V-B, Figure 4",
        (Below("cd_mean", FFT_SIREN, HASH_SIREN), Below("cd_mean", FFT_HOSC, HASH_HOSC)),
        note="tested as: its mean CD, failed shapes counted, is above that of Fourier features",
    ),
    Claim(
        "Positional encoding counters the overfitting of periodic activations alone",
        "section III-B and conclusion",
        tuple(Below("excess_median", row, SIREN, role="held_out") for row in FFT_ROWS),
        note="tested as: lower median excess on shapes that were held out",
    ),
    Claim(
        "Normals improve generalization",
        "conclusion",
        tuple(
            Below("excess_median", (method, "on"), (method, "off"), role="held_out")
            for method in ("SIREN", "FFT/SIREN", "FFT/HOSC")
        ),
        note="tested as: lower median excess on shapes that were held out",
    ),
    Claim(
        "All compatible positional encodings capture finer details",
        "section V-B",
        tuple(Below("excess_median", row, SIREN) for row in (FFT_SIREN, HASH_SIREN)),
        note="tested as: lower median excess than SIREN without one, of Fourier features and of a hash",
    ),
    Claim(
        "Data augmentation mitigates overfitting",
        "conclusion",
        note="no sweep has it; data.loader.augmentation.copies gives a shape further copies",
    ),
    Claim(
        "Orders of magnitude better than DeepSDF",
        "introduction, contribution 3",
        beats(FFT_ROWS, DEEPSDF, ("excess_mean",), 0.1),
        needs="any",
        note="tested as: a tenth of its mean excess in one of the two rows; the paper's own tables show "
        "factors of 1.6 to 2.1 in CD",
    ),
    Claim(
        "FFT/SIREN and FFT/HOSC halve DeepSDF's excess, mean and median, in under 0.4 of its time",
        "what this repository expects",
        beats(FFT_ROWS, DEEPSDF, ("excess_mean", "excess_median"), 0.5)
        + beats(FFT_ROWS, DEEPSDF, ("seconds",), 0.4),
    ),
    Claim(
        "HOSC captures sharp features better than SIREN, and is noisier",
        "section V-B, Figure 3",
        note="no figure here measures sharpness: look at the contact sheet and turn the meshes",
    ),
    Claim(
        "Settings tuned on 100 shapes do not carry over to larger sets",
        "section V-A",
        note="needs the same settings at two sizes, which no one sweep has",
    ),
)


@dataclass(frozen=True)
class Comparison:
    """A comparison as it stands.

    Args:
        holds: None where it cannot be said.
        overlap: whether intervals over seeds overlap; None where a side has none.
        figures: the figures, or what is missing, in words.
    """

    holds: bool | None
    overlap: bool | None
    figures: str


@dataclass(frozen=True)
class Verdict:
    """A claim as it stands; `doubt` says what the verdict may owe to chance."""

    claim: Claim
    state: Literal["holds", "does not hold", "not tested"]
    doubt: str
    figures: list[str]


def compared(below: Below, rows: pd.DataFrame) -> Comparison:
    """A comparison in a group of rows, as lines of table.csv."""
    sides = []
    is_cd = below.quantity.startswith(("cd_", "excess_"))
    for method, normals in (below.left, below.right):
        lines = rows[(rows["method"] == method) & (rows["normals"] == normals) & (rows["role"] == below.role)]
        if len(lines) != 1:
            why = "several rows" if len(lines) else "no such row"
            return Comparison(None, None, f"{why}: {method}, normals {normals}")
        line = lines.iloc[0]
        if pd.isna(line.get(below.quantity)):
            return Comparison(None, None, f"no figure of: {line['label']}")
        if is_cd and pd.isna(line.get("normal_consistency_mean", 1)):
            return Comparison(None, None, f"no shape has a surface: {line['label']}")
        sides.append((line["label"], line[below.quantity], line.get(f"{below.quantity}_ci95", float("nan"))))
    (left, a, a_half), (right, b, b_half) = sides
    if is_cd and below.role == "train" and min(a, b) > FAR:
        return Comparison(None, None, f"neither is near its shapes: {left}, {right}")
    if is_cd and below.factor != 1 and b <= NOISE:
        return Comparison(None, None, f"no more than noise to take a share of: {right} {b:.4f}")
    factor = "" if below.factor == 1 else f"{below.factor:.2g} x "
    what = below.quantity.replace("_", " ") + (" of held-out shapes" if below.role == "held_out" else "")
    sign = "<" if a < below.factor * b else "not <"
    words = [shown(below.quantity, value) for value in (a, b)]
    text = f"{what}: {left} {words[0]} {sign} {factor}{right} {words[1]}"
    if is_cd and abs(a - below.factor * b) < NOISE:
        return Comparison(None, None, f"{text} (by less than the noise of sampling)")
    room = a_half + below.factor * b_half
    overlap = None if pd.isna(room) else bool(abs(a - below.factor * b) < room)
    overlap = False if below.quantity == "parameters" else overlap
    return Comparison(sign == "<", overlap, text + (" (intervals overlap)" if overlap else ""))


def verdict(claim: Claim, rows: pd.DataFrame, sweep: str) -> Verdict:
    """A claim in a group of rows of a sweep, as lines of table.csv."""
    reason = "trains for seconds" if sweep == "smoke" else ""
    if claim.sweep and claim.sweep != sweep:
        reason = f"tested by sweeps={claim.sweep}"
    if not claim.rule or reason:
        return Verdict(claim, "not tested", "", [reason] if reason else [])
    outcomes = [compared(below, rows) for below in claim.rule]
    # of a claim that needs intervals apart, an overlap is a no, and no interval leaves it open
    states = [
        (None if one.overlap is None else not one.overlap) if claim.apart and one.holds else one.holds
        for one in outcomes
    ]
    decisive, otherwise = (False, True) if claim.needs == "all" else (True, False)
    state = decisive if decisive in states else None if None in states else otherwise
    overlaps = [one.overlap for one, holds in zip(outcomes, states, strict=True) if holds is state]
    # one clear comparison settles a decisive state; otherwise each of them must be clear
    doubtful = all if state is decisive else any
    doubt = ""
    if state is not None and not claim.apart and doubtful(overlap is True for overlap in overlaps):
        doubt = "within seed noise"
    elif state is not None and doubtful(
        overlap in ((None,) if claim.apart else (None, True)) for overlap in overlaps
    ):
        doubt = "one seed"
    figures = list(dict.fromkeys(one.figures for one in outcomes))
    trained_on = sorted({int(count) for count in rows["trained_on"].dropna()})
    if sweep in TRAINED_ON and claim.sweep and trained_on not in ([], [TRAINED_ON[sweep]]):
        ours = " to ".join(map(str, dict.fromkeys((trained_on[0], trained_on[-1]))))
        figures.append(f"on {ours} shapes, the paper's table on {TRAINED_ON[sweep]}")
    return Verdict(claim, {True: "holds", False: "does not hold", None: "not tested"}[state], doubt, figures)


def shown(quantity: str, value: float) -> str:
    """A figure as it is printed."""
    if quantity == "seconds":
        return duration(value)
    return f"{value:,.0f}" if quantity == "parameters" else f"{value:.4f}"


def beside_paper(rows: pd.DataFrame, sweep: str) -> pd.DataFrame:
    """CD of training shapes and cost of each row, and their ratios to DeepSDF's, ours and the paper's."""
    printed = PRINTED["table_large" if sweep == "table_large" else "table_small"]
    train = rows[rows["role"] == "train"]
    ours = train.set_index("label")[["cd_mean", "cd_median", "parameters", "seconds"]]
    names = zip(train["method"], train["normals"], train["detail"].isna(), strict=True)
    none = (float("nan"),) * 2
    paper = [
        printed.get((method, normals), none) + COSTS.get((method, normals), none) if plain else none + none
        for method, normals, plain in names
    ]
    paper = pd.DataFrame(paper, index=ours.index, columns=ours.columns)
    deepsdf = train.index[(train["method"] == "DeepSDF") & (train["normals"] == "off")]
    rival = ours.loc[train.loc[deepsdf[0], "label"]] if len(deepsdf) == 1 else ours.iloc[0] * float("nan")
    rival_of_paper = pd.Series(printed[DEEPSDF] + COSTS[DEEPSDF], index=ours.columns)
    parts = {
        "": ours,
        ", paper": paper,
        " / DeepSDF": ours / rival,
        " / DeepSDF, paper": paper / rival_of_paper,
    }
    frame = pd.concat([part.add_suffix(suffix) for suffix, part in parts.items()], axis=1)
    ordered = [f"{name}{suffix}" for name in ours.columns for suffix in parts]
    return frame[ordered].map(lambda value: "" if pd.isna(value) else f"{value:.4g}").reset_index()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("where", type=Path, help="folder of a sweep or a report, or a table.csv")
    where = parser.parse_args().where
    files = [where, where / "report" / "table.csv", where / "table.csv"]
    file = next((file for file in files if file.is_file()), None)
    if file is None:
        parser.error(f"{where}: no table.csv there; `sdfhub report {where}` writes one")
    table = pd.read_csv(file, dtype={"detail": str, "settings": str, "sweeps": str})
    places = [name for name in ("category", "data", "scale", "fit", "evaluate", "settings") if name in table]
    for place, rows in table.groupby(places, sort=False, dropna=False):
        sweep = str(rows["sweeps"].iloc[0])
        print(f"\n## {', '.join(str(word) for word in place if pd.notna(word))}\n")
        print("The paper's figures are from other data: compare ratios.\n")
        print(beside_paper(rows, sweep).to_markdown(index=False, disable_numparse=True))
        verdicts = [verdict(claim, rows, sweep) for claim in CLAIMS]
        lines = [
            [one.claim.text, one.claim.source, f"{one.state} ({one.doubt})" if one.doubt else one.state]
            + ["; ".join([*one.figures, one.claim.note]).strip("; ")]
            for one in verdicts
        ]
        frame = pd.DataFrame(lines, columns=["claim", "source", "verdict", "figures"])
        print(f"\n{frame.to_markdown(index=False, disable_numparse=True)}")


if __name__ == "__main__":
    sys.exit(main())
