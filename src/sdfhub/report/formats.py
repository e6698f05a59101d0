"""Tables as Markdown and LaTeX, rows as CSV; whatever stands in a cell stays text."""

import csv
import html
import io
from collections.abc import Callable

from sdfhub.report.results import ROLES
from sdfhub.report.rows import THOUSANDFOLD, Group
from sdfhub.report.tables import Table

PLACES = ("category", "data", "scale", "fit", "evaluate")
"""Choices that a line of a CSV file tells."""


def markdown(tables: list[Table]) -> str:
    """Tables as GitHub's Markdown."""
    parts = []
    for table in tables:
        cells = _marked(table, _markdown_cell, "**{}**")
        lines = [[_markdown_cell(text) for text in table.head], ["---"] * len(table.head), *cells]
        grid = "\n".join("| " + " | ".join(line) + " |" for line in lines)
        notes = "".join(f"\n{_markdown_cell(note)}\n" for note in table.notes)
        parts.append(f"### {_markdown_cell(table.title)}\n\n{grid}\n{notes}")
    return "\n".join(parts)


def _marked(table: Table, escaped: Callable[[str], str], bold: str) -> list[list[str]]:
    """The rows of a table as its format writes them, the best cells in bold."""
    return [
        [bold.format(escaped(t)) if (i, j) in table.best else escaped(t) for j, t in enumerate(row)]
        for i, row in enumerate(table.rows)
    ]


def _markdown_cell(text: str) -> str:
    plain = html.escape(text, quote=False)
    for character in "\\|*_`[]":
        plain = plain.replace(character, f"\\{character}")
    return " ".join(plain.split())


LATEX = {
    "\\": r"\textbackslash{}",
    "{": r"\{",
    "}": r"\}",
    "_": r"\_",
    "^": r"\textasciicircum{}",
    "~": r"\textasciitilde{}",
    "±": r"$\pm$",
    "–": "--",
    "³": r"\textsuperscript{3}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
} | {character: f"\\{character}" for character in "&%$#"}


def latex(tables: list[Table]) -> str:
    """A document that compiles; each of its tables stands for itself and can be copied out (booktabs)."""
    body = "\n\n".join(map(_latex_table, tables))
    return (
        "\\documentclass{article}\n\\usepackage[landscape,margin=1.5cm]{geometry}\n"
        "\\usepackage{booktabs,graphicx}\n\\begin{document}\n\n" + body + "\n\n\\end{document}\n"
    )


def _latex_table(table: Table) -> str:
    cells = _marked(table, _latex_cell, r"\textbf{{{}}}")
    lines = [" & ".join(line) + r" \\" for line in (map(_latex_cell, table.head), *cells)]
    notes = "".join(f"\\par\\smallskip\\footnotesize {_latex_cell(note)}\n" for note in table.notes)
    return (
        f"\\begin{{table}}[p]\\centering\n\\caption{{{_latex_cell(table.title)}}}\n"
        "\\resizebox{\\ifdim\\width>\\linewidth\\linewidth\\else\\width\\fi}{!}{%\n"
        f"\\begin{{tabular}}{{l{'r' * (len(table.head) - 1)}}}\n\\toprule\n{lines[0]}\n\\midrule\n"
        + "\n".join(lines[1:])
        + f"\n\\bottomrule\n\\end{{tabular}}}}\n{notes}\\end{{table}}"
    )


def _latex_cell(text: str) -> str:
    plain = text.replace("×", "x")
    return "".join(LATEX.get(c, c if c.isascii() and c.isprintable() else "?") for c in plain)


def shapes_csv(groups: list[Group]) -> str:
    """Every judged shape of every cell as numbers: a line a seed, role and shape.

    Chamfer distances in normalised units squared, not times 10^3; no `cd` where there is no surface, whose
    excess counts the CD of a single point.
    """
    head = [*PLACES, "settings", "method", "normals", "detail", "seed", "role", "shape"]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*head, "cd", "floor", "excess", "normal_consistency"])
    for group in groups:
        for row in group.rows:
            for cell in row.done:
                place = [*_place(group), row.method, row.normals, row.detail, cell.plan.seed]
                for role, shapes in cell.scores.shapes.items():
                    for s in shapes:
                        numbers = [None if s.failed else s.cd, s.floor, s.excess, s.normal_consistency]
                        writer.writerow([*place, role, s.id, *numbers])
    return text.getvalue()


def _place(group: Group) -> list[str]:
    """The columns that tell a group from others."""
    said = ";".join(f"{key}={value}" for key, value in (group.said | group.settings).items())
    return [*(group.choices.get(name, "") for name in PLACES), said]


def csv_text(groups: list[Group]) -> str:
    """Every row of every group as numbers: a line a role, mean, half width and seeds of each quantity.

    Chamfer distances in normalised units squared, not times 10^3; times in seconds.
    """
    quantities = (*THOUSANDFOLD, "floor_mean", "no_surface", "normals_mean")
    quantities += ("sdf_error_mean", "sdf_error_median", "sign_accuracy_mean")
    costs = ("seconds", "parameters", "epochs", "steps", "samples", "trained_on")
    named: list[Callable] = [lambda e: e.mean, lambda e: e.half_width, lambda e: e.seeds]
    head = [*PLACES, "settings", "method", "normals", "detail", "role", "cells"]
    head += [f"{quantity}{part}" for quantity in quantities for part in ("", "_ci95", "_seeds")]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*head, *costs])
    for group in groups:
        place = _place(group)
        for row in group.rows:
            for role in ROLES:
                found = [row.estimate(quantity, role) for quantity in quantities]
                numbers = [part(e) if e else None for e in found for part in named]
                spent = [e.mean if (e := row.estimate(cost)) else None for cost in costs]
                line = [*place, row.method, row.normals, row.detail, role, len(row.cells), *numbers, *spent]
                writer.writerow(line)
    return text.getvalue()
