"""Groups of rows as tables of text: scores, the paper's figures beside them, costs, claims."""

from collections.abc import Callable
from dataclasses import dataclass

from sdfhub.report.claims import verdicts
from sdfhub.report.paper import COSTS, PRINTED
from sdfhub.report.results import ROLES
from sdfhub.report.rows import Estimate, Group, Row, duration, rank

NONE = "–"
"""An empty cell of a table."""

QUANTITIES = ("cd_mean", "cd_median", "floor_mean", "excess_mean", "excess_median")
"""Columns of a table of scores."""

TITLES = {"known": "Known shapes", "held_out": "Held-out shapes"}


@dataclass(frozen=True)
class Table:
    """A table of text.

    Args:
        title: what it shows.
        head: a heading per column; the first column names the row.
        rows: a text per column.
        notes: lines below it.
        best: row and column of the cells that are the best of their column.
    """

    title: str
    head: list[str]
    rows: list[list[str]]
    notes: list[str]
    best: frozenset[tuple[int, int]] = frozenset()


def tables(group: Group) -> list[Table]:
    """The tables of a group: scores by role, known ones beside the paper, costs, and what is missing."""
    roles = _judged_by(group, "cd_mean")
    found = [_scores(group, role) for role in roles]
    beside = [_beside_paper(group)] if "known" in roles and not all(row.detail for row in group.rows) else []
    distances = [
        _distances(group, role)
        for role in ROLES
        if any(r.estimate("sdf_error_mean", role) for r in group.rows)
    ]
    return [*found[:1], *beside, *found[1:], *distances, _costs(group), *_missing(group)]


def overview(groups: list[Group]) -> list[Table]:
    """Mean and median excess of every row in every group, a table a role; none where there is one group."""
    if len(groups) < 2:
        return []
    common = set.intersection(*(set(group.title_parts) for group in groups))
    names = [
        ", ".join(part for k, part in enumerate(group.title_parts) if k == 0 or part not in common)
        for group in groups
    ]
    by_label = [{row.label: row for row in group.rows} for group in groups]
    labels = sorted(dict.fromkeys(label for rows in by_label for label in rows), key=_place(groups))
    found = []
    for role in ROLES:
        rows = [[label, *(_excess(rows.get(label), role) for rows in by_label)] for label in labels]
        if any(cell != NONE for row in rows for cell in row[1:]):
            title = f"{TITLES[role]}, excess mean and median: all tables"
            found.append(Table(title, ["method", *names], rows, [_OVERVIEW_NOTE]))
    return found


_OVERVIEW_NOTE = (
    "Excess CD over the noise floor times 10³, mean and median over shapes; in brackets the seeds that they "
    "are means of, where these are several: the tables below have their intervals."
)


def _place(groups: list[Group]) -> Callable[[str], tuple[int, int]]:
    """Sorts labels as the paper's rows, then as the groups have them."""
    places = {row.label: (k, row) for group in groups for k, row in enumerate(group.rows)}
    return lambda label: (rank(places[label][1].method), places[label][0])


def _excess(row: Row | None, role: str) -> str:
    values = [row.estimate(f"excess_{one}", role) for one in ("mean", "median")] if row else []
    told = [_told(v, 4 if abs(v.mean) < 0.01 else 2, 1e3).partition(" ")[0] for v in values if v]
    several = f" ({values[0].seeds})" if told and values[0].seeds > 1 else ""
    return f"{', '.join(told)}{several}" if told else NONE


def _judged_by(group: Group, quantity: str) -> list[str]:
    return [role for role in ROLES if any(row.estimate(quantity, role) for row in group.rows)]


def _scores(group: Group, role: str) -> Table:
    head = ["method", "CD mean", "CD median", "floor", "excess mean", "excess median"]
    head += ["normals", "no surface", "seeds"]
    rivals = [f"excess {one} / DeepSDF" for one in ("mean", "median") if group.rows_of("DeepSDF", "off")]
    rows = []
    for row in group.rows:
        cells = [_thousandth(row.estimate(quantity, role)) for quantity in QUANTITIES]
        cells += [_told(row.estimate("normals_mean", role), 3), _no_surface(row, role), _seeds(row)]
        cells += [_ratio(group, row, q, role) for q in ("excess_mean", "excess_median") if rivals]
        rows.append([row.label, *cells])
    notes = [
        "CD, floor and excess times 10³, normalised frame; excess is CD above the noise floor of two "
        "samplings of the truth. Shapes without a surface count with the CD of a single point. Normals: mean "
        "|cos| between those of the reconstruction and of the truth, of shapes with a surface. The floor "
        "is a mean over shapes: that of a single one, and so a median CD, may lie below it. "
        "± is a 95% confidence interval over seeds (Student's t); bold: the lowest, however near others are."
    ]
    if group.settings:
        notes.append(f"All rows with {', '.join(f'{key}={value}' for key, value in group.settings.items())}.")
    title = f"{TITLES[role]}: {group.title}"
    return Table(title, [*head, *rivals], rows, notes, _best(group, role))


def _distances(group: Group, role: str) -> Table:
    """Scores of a source without meshes, such as DeepSDF's npz files."""
    head = ["method", "|f - d| mean", "|f - d| median", "signs right", "seeds", "mean / DeepSDF"]
    rows = []
    for row in group.rows:
        errors = [_thousandth(row.estimate(f"sdf_error_{one}", role)) for one in ("mean", "median")]
        signs = _told(row.estimate("sign_accuracy_mean", role), 4)
        rows.append([row.label, *errors, signs, _seeds(row), _ratio(group, row, "sdf_error_mean", role)])
    note = (
        "The source holds no meshes, so that no Chamfer distance can be had. |f - d| times 10³: mean over a "
        "shape's samples near its surface, then over shapes; signs right: share of samples."
    )
    return Table(f"{TITLES[role]}, signed distances: {group.title}", head, rows, [note])


def _beside_paper(group: Group) -> Table:
    """CD of known shapes and its ratio to DeepSDF's, ours and what the paper prints."""
    is_large = group.choices.get("sweeps") == "table_large"
    printed = PRINTED["table_large" if is_large else "table_small"]
    rows = []
    for row in group.rows:
        cells = []
        for quantity in ("cd_mean", "cd_median"):
            figures = {} if row.detail else printed.get((row.method, row.normals), {})
            value, rival = figures.get(quantity), printed["DeepSDF", "off"][quantity]
            cells += [_thousandth(row.estimate(quantity)), f"{value * 1e3:.4f}" if value else NONE]
            cells += [_ratio(group, row, quantity), f"{value / rival:.3g}" if value else NONE]
        rows.append([row.label, *cells])
    head = [
        f"CD {statistic}{end}"
        for statistic in ("mean", "median")
        for end in ("", ", paper", " / DeepSDF", " / DeepSDF, paper")
    ]
    notes = [f"The paper's columns are its Table {3 if is_large else 2}, from other data: compare ratios."]
    return Table(f"Beside the paper: {group.title}", ["method", *head], rows, notes)


def _ratio(group: Group, row: Row, quantity: str, role: str = "known") -> str:
    """The row's value over DeepSDF's; none where that says nothing (an excess at or below 0)."""
    measured_by = group.rival(row)
    rival = measured_by.estimate(quantity, role) if measured_by else None
    own = row.estimate(quantity, role)
    return f"{own.mean / rival.mean:.3g}" if own and rival and min(own.mean, rival.mean) > 0 else NONE


def _best(group: Group, role: str) -> frozenset[tuple[int, int]]:
    """Row and column of the lowest value of each quantity but the floor, which is no row's merit."""
    found = set()
    for column, quantity in enumerate(QUANTITIES, start=1):
        rows = [(k, row) for k, row in enumerate(group.rows) if row.has_surfaces(role)]
        values = {k: row.estimate(quantity, role).mean for k, row in rows}
        if len(group.rows) > 1 and values and quantity != "floor_mean":
            best = min(values.values())
            found |= {(k, column) for k, value in values.items() if value == best}
    return frozenset(found)


def _costs(group: Group) -> Table:
    head = ["method", "shapes", "parameters", "epochs", "steps", "samples", "training time"]
    head += ["time / DeepSDF", "paper: parameters", "paper: training time", "paper: time / DeepSDF"]
    rows = []
    for row in group.rows:
        counts = [
            _count(row.estimate(key)) for key in ("trained_on", "parameters", "epochs", "steps", "samples")
        ]
        seconds = row.estimate("seconds")
        paper = COSTS.get((row.method, row.normals)) if not row.detail else None
        printed = [NONE] * 3
        if paper:
            share = paper["seconds"] / COSTS["DeepSDF", "off"]["seconds"]
            printed = [f"{paper['parameters']:,.0f}", f"{paper['seconds'] / 3600:.0f} h", f"{share:.3g}"]
        time = NONE if seconds is None else duration(seconds.mean)
        time += f" ± {duration(seconds.half_width)}" if seconds and seconds.half_width else ""
        rows.append([row.label, *counts, time, _ratio(group, row, "seconds"), *printed])
    notes = [
        "Samples are signed distances drawn in all. Times compare on one machine with nothing beside it."
    ]
    return Table(f"Cost: {group.title}", head, rows, notes)


def _missing(group: Group) -> list[Table]:
    """The cells without scores, each with its reason; no table where there are none."""
    lines = [
        [f"{row.label}, seed {cell.plan.seed}", cell.state, cell.reason]
        for row in group.rows
        for cell in row.cells
        if cell.state != "done"
    ]
    return [Table(f"Not there: {group.title}", ["cell", "state", "reason"], lines, [])] if lines else []


def claims_table(group: Group) -> Table:
    """Every claim of the paper with its verdict and the figures behind it."""
    rows = [
        [one.claim.text, one.claim.source, one.told, "; ".join([*one.figures, one.claim.note]).strip("; ")]
        for one in verdicts(group)
    ]
    return Table(f"Claims of the paper: {group.title}", ["claim", "source", "verdict", "figures"], rows, [])


def _thousandth(value: Estimate | None) -> str:
    """A Chamfer distance times 10^3, four digits below 10 and fewer above, with its interval."""
    return _told(value, 4 if value and abs(value.mean) < 0.01 else 2, 1e3)


def _told(value: Estimate | None, places: int, factor: float = 1.0) -> str:
    if value is None:
        return NONE
    half = f" ± {value.half_width * factor:.{places}f}" if value.half_width else ""
    return f"{value.mean * factor:.{places}f}{half}"


def _count(value: Estimate | None) -> str:
    return NONE if value is None else f"{value.mean:,.0f}"


def _no_surface(row: Row, role: str) -> str:
    shapes = [cell.scores.shapes.get(role, []) for cell in row.done]
    return f"{sum(s.failed for one in shapes for s in one)}/{sum(map(len, shapes))}" if row.done else NONE


def _seeds(row: Row) -> str:
    states = {cell.state for cell in row.cells}
    if not row.done:
        return "failed" if "failed" in states else "missing"
    return f"{len(row.done)}/{len(row.cells)}"
