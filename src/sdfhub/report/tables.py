"""Groups of rows as tables of text, and these as Markdown and LaTeX, in which every string stays text."""

import html
import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import pandas as pd

from sdfhub.report.results import ROLES, Cell
from sdfhub.report.rows import NONE, Group, differing, settings_of

TITLES = {"train": "Training shapes", "held_out": "Held-out shapes"}

# columns of `Group.statistics` by their headings: of shapes with meshes, and of those without
SURFACES = {"CD mean": "cd_mean", "CD median": "cd_median", "floor": "floor_mean"}
SURFACES |= {"excess mean": "excess_mean", "excess median": "excess_median"}
SURFACES |= {"normals": "normal_consistency_mean", "no surface": "no_surface"}
DISTANCES = {"|f - d| mean": "sdf_error_mean", "|f - d| median": "sdf_error_median"}
DISTANCES |= {"signs right": "sign_accuracy_mean"}

ABOUT_CD = (
    "CD, floor and excess times 10³, normalised frame; excess is CD above the noise floor of two samplings "
    "of the truth. A shape without a surface counts with the CD of a single point. Normals: mean |cos| "
    "between those of reconstruction and truth. ± is a 95% confidence interval over seeds (Student's t)."
)
ABOUT_DISTANCES = "No meshes, no CD. |f - d| times 10³, over samples near a surface, then over shapes."
ABOUT_OVERVIEW = "Excess CD times 10³, mean and median over shapes; in brackets the number of seeds."
ABOUT_COSTS = "Samples are signed distances drawn in all. Times compare on one idle machine."
ABOUT_SETTINGS = "Read from config.yaml of each row's first finished cell; the seed and paths left out."


@dataclass(frozen=True)
class Table:
    """A table of text."""

    title: str
    frame: pd.DataFrame  # of strings; the first column names the row
    note: str = ""
    best: set[tuple[int, int]] = field(default_factory=set)  # row and column of the best of a column
    prose: bool = False  # whether cells are words, to be set flush left


def tables(group: Group) -> list[Table]:
    """The tables of a group: scores by role, differing settings, costs, and the cells without scores."""
    kinds = (("", SURFACES, ABOUT_CD), (", signed distances", DISTANCES, ABOUT_DISTANCES))
    scores = [_scores(group, role, *kind) for role in ROLES for kind in kinds]
    first = {row.label: settings_of(row.first) for row in group.rows if row.first}
    lines = sorted((key, *values) for key, values in differing(list(first.values())).items())
    frame = pd.DataFrame(lines, columns=["setting", *first])
    settings = Table("Settings that differ", frame, ABOUT_SETTINGS, prose=True)
    cells = [(row, cell) for row in group.rows for cell in row.cells if cell.state != "done"]
    reasons = [[f"{row.label}, seed {cell.plan.seed}", cell.state, cell.reason] for row, cell in cells]
    absent = Table("Not there", pd.DataFrame(reasons, columns=["cell", "state", "reason"]), prose=True)
    return [table for table in (*scores, settings, _costs(group), absent) if table and len(table.frame)]


def overview(groups: list[Group]) -> list[Table]:
    """Mean and median excess of every row in every group, a table a role; none where there is one group."""
    if len(groups) < 2:
        return []
    common = set.intersection(*(set(group.title) for group in groups))
    labels = list(dict.fromkeys(row.label for group in groups for row in group.rows))
    overviews = []
    for role in ROLES:
        frame = pd.DataFrame({"method": labels})
        for group in groups:
            column = ", ".join(part for k, part in enumerate(group.title) if k == 0 or part not in common)
            lines = _lines(group, role).reindex(labels)
            means, medians = (_texts(lines, f"excess_{name}", False) for name in ("mean", "median"))
            seeds = [f" ({n:.0f})" if n > 1 else "" for n in lines["excess_mean_seeds"]]
            parts = zip(means, medians, seeds, strict=True)
            texts = [NONE if mean == NONE else f"{mean}, {median}{count}" for mean, median, count in parts]
            frame.insert(len(frame.columns), column, texts, allow_duplicates=True)
        if (frame.iloc[:, 1:] != NONE).any(axis=None):
            overviews.append(Table(f"{TITLES[role]}, excess", frame, ABOUT_OVERVIEW))
    return overviews


def origin(commands: list[str], cells: list[Cell]) -> Table:
    """How a sweep was made: its commands, how long it trained, versions and hardware."""
    done = [cell.scores.training for cell in cells if cell.state == "done"]
    made_with = Counter(", ".join(f"{k} {v}" for k, v in training.made_with.items()) for training in done)
    spent = duration(sum(training.seconds for training in done))
    lines = [["command", command] for command in commands]
    lines += [["trainings", f"{len(done)} of {len(cells)} done, {spent} in all"]]
    lines += [[f"{count} of them with", words or "not written down"] for words, count in made_with.items()]
    return Table("How it was made", pd.DataFrame(lines, columns=["what", "which"]), prose=True)


def _lines(group: Group, role: str) -> pd.DataFrame:
    """The statistics of a role, a line for each row; not a number where a row has none."""
    rows = pd.MultiIndex.from_product([[row.label for row in group.rows], [role]])
    return group.statistics.reindex(rows).droplevel(1)


def _scores(group: Group, role: str, title: str, quantities: dict[str, str], about: str) -> Table | None:
    lines = _lines(group, role)
    if lines[next(iter(quantities.values()))].isna().all():
        return None
    columns = {name: _texts(lines, quantity) for name, quantity in quantities.items()}
    if "no surface" in columns:
        counts = lines[["no_surface", "shapes"]].mul(lines["shapes_seeds"], axis=0).to_numpy().tolist()
        columns["no surface"] = [NONE if pd.isna(lost) else f"{lost:.0f}/{of:.0f}" for lost, of in counts]
    lines = lines.reset_index(drop=True)
    rivals = lines[lines["no_surface"] < lines["shapes"]]  # without any surface CD is a penalty
    best = {
        (int(row), column)
        for column, quantity in enumerate(quantities.values(), start=1)
        if len(lines) > 1 and quantity.startswith(("cd", "excess"))
        for row in rivals.index[rivals[quantity] == rivals[quantity].min()]
    }
    return Table(TITLES[role] + title, _frame(group, columns), about, best)


def _costs(group: Group) -> Table:
    lines = group.costs.reindex([row.label for row in group.rows])
    names = {"shapes": "trained_on"} | {name: name for name in ("parameters", "epochs", "steps", "samples")}
    columns = {k: [NONE if pd.isna(n) else f"{n:,.0f}" for n in lines[name]] for k, name in names.items()}
    columns["training time"] = [
        NONE if pd.isna(mean) else duration(mean) + (f" ± {duration(half)}" if half > 0 else "")
        for mean, half in zip(lines["seconds"], lines["seconds_ci95"], strict=True)
    ]
    return Table("Cost", _frame(group, columns), ABOUT_COSTS)


def _frame(group: Group, columns: dict[str, list[str]]) -> pd.DataFrame:
    """Columns between the labels of the rows and what the rows rest on: seeds, and a search or none."""
    columns = {"method": [row.label for row in group.rows]} | columns
    seeds = [f"{len(row.done)}/{len(row.cells)}" if row.done else row.state for row in group.rows]
    return pd.DataFrame(columns | {"seeds": seeds, "searched": [row.searched for row in group.rows]})


def _texts(lines: pd.DataFrame, quantity: str, interval: bool = True) -> list[str]:
    """A column as text with its intervals, four places below 10 and two above."""
    texts = []
    for mean, half in lines[[quantity, f"{quantity}_ci95"]].to_numpy():
        places = 4 if abs(mean) < 10 else 2
        spread = f" ± {half:.{places}f}" if interval and half >= 0.5 * 10**-places else ""
        texts.append(NONE if pd.isna(mean) else f"{mean:.{places}f}{spread}")
    return texts


def duration(seconds: float) -> str:
    """`4.8 s`, `48 s`, `12.5 min`, `30.2 h`."""
    if seconds < 120:
        return f"{seconds:.1f} s" if seconds < 10 else f"{seconds:.0f} s"
    return f"{seconds / 60:.1f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


def markdown(title: str, tables: list[Table]) -> str:
    """Tables below a heading as GitHub's Markdown."""
    parts = [f"## {_markdown_text(title)}\n"]
    for table in tables:
        frame = _escaped(table, _markdown_text, "**{}**")
        grid = frame.to_markdown(index=False, tablefmt="github", disable_numparse=True)
        note = f"\n{_markdown_text(table.note)}\n" if table.note else ""
        parts.append(f"### {_markdown_text(table.title)}\n\n{grid}\n{note}")
    return "\n".join(parts)


def latex(sections: list[tuple[str, list[Table]]]) -> str:
    """A document of titled tables that compiles; each table can be copied out (booktabs)."""
    lines = [r"\documentclass{article}", r"\usepackage[T1]{fontenc}", r"\usepackage{booktabs}"]
    lines += [r"\usepackage[landscape,margin=1cm]{geometry}", r"\begin{document}\scriptsize"]
    for title, tables in sections:
        for table in tables:
            frame = _escaped(table, _latex_text, r"\textbf{{{}}}")
            form = "l" + ("l" if table.prose else "r") * (frame.shape[1] - 1)
            caption = _latex_text(f"{table.title}: {title}. {table.note}")
            options: Any = {"column_format": form, "position": "p", "caption": caption}
            lines += [frame.to_latex(index=False, escape=False, **options)]
    return "\n".join([*lines, r"\end{document}", ""])


def _escaped(table: Table, escape: Callable[[str], str], bold: str) -> pd.DataFrame:
    frame = table.frame.map(escape).set_axis(list(map(escape, table.frame.columns)), axis=1)
    for row, column in table.best:
        frame.iat[row, column] = bold.format(frame.iat[row, column])
    return frame


def _markdown_text(text: str) -> str:
    return " ".join(re.sub(r"([\\|*_`\[\]])", r"\\\1", html.escape(str(text), quote=False)).split())


LATEX = {"±": r"$\pm$", "–": "--", "³": r"\textsuperscript{3}", "\\": r"\textbackslash{}"}
LATEX |= {"^": r"\textasciicircum{}", "~": r"\textasciitilde{}"} | {c: f"\\{c}" for c in "&%$#_{}"}


def _latex_text(text: str) -> str:
    """Text that LaTeX prints as it is; question marks for characters that its fonts may lack."""
    return "".join(LATEX.get(c, c if c.isascii() and c.isprintable() else "?") for c in str(text))
