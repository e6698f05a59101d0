"""The report as one HTML page that opens offline: text is escaped, and its policy lets no request out."""

import base64
import hashlib
import io
from datetime import UTC, datetime
from importlib.resources import files

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from PIL import Image

from sdfhub.report.charts import loss_chart, shape_chart
from sdfhub.report.pictures import Sheet
from sdfhub.report.results import ROLES, Cell
from sdfhub.report.rows import Group
from sdfhub.report.tables import TITLES, Table


def page(
    name: str,
    cells: list[Cell],
    groups: list[Group],
    tables: list[list[Table]],
    sheets: list[Sheet],
    turning: list,
) -> str:
    """The whole page as text.

    Args:
        name: of the sweep.
        cells: all of them.
        groups: their rows.
        tables: those of all groups first, then each group's, then how the sweep was made.
        sheets, turning: of each group, the contact sheet, and the meshes to turn.
    """
    overview, *tables, origin = tables
    parts = [
        {"title": group.title, "tables": own, "charts": _charts(group), "sheet": sheet, "turning": meshes}
        for group, own, sheet, meshes in zip(groups, tables, sheets, turning, strict=True)
    ]
    states = [cell.state for cell in cells]
    counts = [f"{states.count(state)} {state}" for state in ("failed", "missing") if state in states]
    script = _text("viewer.js")
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    loader = PackageLoader("sdfhub.report", ".")
    environment = Environment(loader=loader, autoescape=True, undefined=StrictUndefined)
    environment.filters["data_uri"] = _picture_uri
    return environment.get_template("page.html.j2").render(
        name=name,
        counts=", ".join([f"{states.count('done')} of {len(cells)} cells done", *counts]),
        written=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        overview=overview,
        parts=parts,
        origin=origin,
        style=Markup(_text("page.css")),
        script=Markup(script),
        script_hash=Markup(f"sha256-{digest}"),
    )


def _charts(group: Group) -> list[tuple[str, str]]:
    charts = {"Loss of signed distances while training, a line a seed": loss_chart(group)}
    for role in ROLES:
        charts[f"{TITLES[role]}: CD of each, all seeds; the bar is the median"] = shape_chart(group, role)
    return [(caption, chart) for caption, chart in charts.items() if chart]


def _picture_uri(image: np.ndarray) -> str:
    content = io.BytesIO()
    Image.fromarray(image).save(content, "WEBP", quality=82)
    return "data:image/webp;base64," + base64.b64encode(content.getvalue()).decode()


def _text(name: str) -> str:
    return files("sdfhub.report").joinpath(name).read_text(encoding="utf-8")
