"""The report as one HTML page that opens offline: text is escaped, and its policy lets no request out."""

import base64
import hashlib
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.resources import files
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from sdfhub.report.charts import Series, line_chart, strip_chart
from sdfhub.report.claims import Verdict, verdicts
from sdfhub.report.curves import curves_of
from sdfhub.report.origin import installed_version
from sdfhub.report.pictures import Gallery, Sheet, data_uri
from sdfhub.report.results import Cell
from sdfhub.report.rows import Group, Row
from sdfhub.report.tables import Table, overview, tables

Curves = dict[Path, list[tuple[int, float]]]
"""Points of the curve of each run."""

COLOURS = 8

MESH_BYTES, TO_TURN = 4_000_000, 4
"""Room for meshes on a page, and shapes to turn for each group."""


@dataclass(frozen=True)
class Part:
    """What the page says about a group of comparable rows."""

    title: str
    tables: list[Table]
    missing: list[list[str]]
    verdicts: list[Verdict]
    charts: list[tuple[str, Markup]]
    legend: list[tuple[str, int, bool]]
    sheet: Sheet
    extremes: Sheet
    meshes: int | None


def page(
    name: str, cells: list[Cell], groups: list[Group], origin: Table, gallery: Gallery, shapes: int
) -> str:
    """The whole page as text.

    Args:
        name: of the sweep.
        cells: all of them.
        groups: their rows.
        origin: how it was made.
        gallery: draws shapes.
        shapes: on a contact sheet.
    """
    turning = [gallery.turning(group, min(shapes, TO_TURN), MESH_BYTES // len(groups)) for group in groups]
    sheets = [(gallery.sheet(group, shapes), gallery.extremes(group)) for group in groups]
    gallery.draw()
    curves = curves_of([cell.folder for group in groups for row in group.rows for cell in row.done])
    meshes, parts = [], []
    for group, to_turn, pictures in zip(groups, turning, sheets, strict=True):
        found = [{"name": shape.name, "role": shape.role, "panels": shape.panels()} for shape in to_turn]
        found = [shape for shape in found if shape["panels"]]
        parts.append(_part(group, curves, *pictures, len(meshes) if found else None))
        meshes += [found] if found else []
    script = _text("viewer.js")
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    return _template().render(
        name=name,
        counts=_counts(cells),
        written=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        version=installed_version("sdfhub"),
        overview=overview(groups),
        parts=parts,
        meshes=meshes,
        origin=origin,
        style=Markup(_text("page.css")),
        script=Markup(script),
        script_hash=Markup(f"sha256-{digest}"),
    )


def _part(group: Group, curves: Curves, sheet: Sheet, extremes: Sheet, meshes: int | None) -> Part:
    colours = {method: k % COLOURS for k, method in enumerate(dict.fromkeys(r.method for r in group.rows))}
    found = tables(group)
    return Part(
        title=group.title,
        tables=found,
        missing=[row for table in found if table.head[0] == "cell" for row in table.rows],
        verdicts=verdicts(group),
        charts=_charts(group, curves, colours),
        legend=[(row.label, colours[row.method], row.normals != "on") for row in group.rows if row.done],
        sheet=sheet,
        extremes=extremes,
        meshes=meshes,
    )


def _charts(group: Group, curves: Curves, colours: dict[str, int]) -> list[tuple[str, Markup]]:
    def series(row: Row, values: list) -> Series:
        return Series(row.label, colours[row.method], row.normals != "on", values)

    lines = [series(row, curves[cell.folder]) for row in group.rows for cell in row.done]
    found = [
        ("Loss of signed distances while training, a line a seed", line_chart(lines, "step", "clamped L1"))
    ]
    for role, words in (("known", "known"), ("held_out", "held-out")):
        rows = [series(row, _distances(row, role)) for row in group.rows if row.done]
        floors = [e.mean * 1e3 for row in group.rows if (e := row.estimate("floor_mean", role))]
        marks = [(sum(floors) / len(floors), "noise floor")] if floors else []
        chart = strip_chart(rows, "CD times 10³", marks)
        found.append((f"CD of each {words} shape, all seeds; the bar is the median", chart))
    return [(caption, chart) for caption, chart in found if chart]


def _distances(row: Row, role: str) -> list[tuple[float, str]]:
    return [
        (shape.counted_cd * 1e3, f"{shape.id}, seed {cell.plan.seed}{', no surface' * shape.failed}")
        for cell in row.done
        for shape in cell.scores.shapes.get(role, [])
    ]


def _counts(cells: list[Cell]) -> str:
    states = [cell.state for cell in cells]
    told = [f"{states.count(state)} {state}" for state in ("failed", "missing") if state in states]
    return ", ".join([f"{states.count('done')} of {len(cells)} cells done", *told])


def _template():
    environment = Environment(
        loader=PackageLoader("sdfhub.report", "."), autoescape=True, undefined=StrictUndefined
    )
    environment.filters["data_uri"] = data_uri
    return environment.get_template("page.html.j2")


def _text(name: str) -> str:
    return files("sdfhub.report").joinpath(name).read_text(encoding="utf-8")
