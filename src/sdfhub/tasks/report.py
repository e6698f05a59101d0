"""Task `report`: a sweep's folder becomes tables, pictures and one page that opens offline."""

import base64
import hashlib
import logging
import re
from datetime import UTC, datetime
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from omegaconf import DictConfig

from sdfhub.data.store.store import Store, preparation_hash
from sdfhub.data.store.stored_shape import StoredShape
from sdfhub.errors import SdfhubError
from sdfhub.geometry.picture_file import contact_sheet
from sdfhub.opening import data_of
from sdfhub.report.charts import charts
from sdfhub.report.pictures import FindTruth, Sheet, contact_sheets, picture_uri, turning_meshes
from sdfhub.report.plan import read_plan
from sdfhub.report.results import Cell, read_sweep
from sdfhub.report.rows import JUDGING_GROUPS, Group, group_cells, shapes_csv, table_csv
from sdfhub.report.tables import Table, latex, markdown, origin, overview, tables
from sdfhub.whole_file import refuse_unwritable, write_whole

log = logging.getLogger(__name__)

MESH_BYTES = 4_000_000  # room for the meshes to turn on a page


def write_report(sweep: Path, out: Path, shapes: int = 6) -> list[Cell]:
    """Writes tables (md, tex, csv), `shapes.csv`, a sheet a group and `report.html`; prints the tables.

    Returns the cells of the sweep, finished or not, of which `shapes` shapes are pictured side by side.

    Raises:
        SdfhubError: not a sweep's folder.
    """
    cells = read_sweep(sweep)
    groups, find_truth = group_cells(cells), truth_finder()
    before, after = overview(groups), [origin(read_plan(sweep).commands, cells)]
    sheets = contact_sheets(groups, shapes, find_truth)
    parts: list[dict[str, Any]] = [
        {"title": group.title, "tables": tables(group), "charts": charts(group), "sheet": sheet}
        | {"turning": turning_meshes(group, shapes, MESH_BYTES // len(groups), find_truth)}
        for group, sheet in zip(groups, sheets, strict=True)
    ]
    sections: list[tuple[str, list[Table]]] = [("All tables", before)] if before else []
    sections += [*((part["title"], part["tables"]) for part in parts), ("Origin", after)]
    text = "\n".join(markdown(title, part) for title, part in sections)
    print(f"\n{text}")
    write_whole(out / "table.md", f"# {sweep.name}\n\n{text}")
    write_whole(out / "table.tex", latex(sections))
    write_whole(out / "table.csv", table_csv(groups))
    write_whole(out / "shapes.csv", shapes_csv(groups))
    for group, sheet in zip(groups, sheets, strict=True):
        write_sheet(sheet, out / f"{sheet_name(group)}.png")
    states = [cell.state for cell in cells]
    counts = [f"{states.count(state)} {state}" for state in ("failed", "missing") if state in states]
    counts = [f"{states.count('done')} of {len(cells)} cells done", *counts]
    content = {"overview": before, "parts": parts, "origin": after}
    write_whole(out / "report.html", page(name=sweep.name, counts=", ".join(counts), **content))
    print(f"report: {out / 'report.html'}", flush=True)
    return cells


def page(**content: Any) -> str:
    """A page that opens offline: text is escaped, and its policy lets no request out."""
    folder = files("sdfhub.report")
    style, script = ((folder / name).read_text("utf-8") for name in ("page.css", "viewer.js"))
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    loader = PackageLoader("sdfhub.report", ".")
    environment = Environment(loader=loader, autoescape=True, undefined=StrictUndefined)
    environment.filters["data_uri"] = picture_uri
    content |= {"style": Markup(style), "script": Markup(script), "script_hash": Markup(f"sha256-{digest}")}
    content["written"] = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    return environment.get_template("page.html.j2").render(content)


def sheet_name(group: Group) -> str:
    """A name of its own for each group of a sweep."""
    choices = [group.judging[name] for name in JUDGING_GROUPS if name in group.judging]
    settings = ";".join(f"{k}={v}" for k, v in sorted(group.judging.items()) if k not in JUDGING_GROUPS)
    digest = [hashlib.sha256(settings.encode()).hexdigest()[:8]] if settings else []
    return re.sub(r"[^A-Za-z0-9._-]", "-", "_".join(["sheet", *choices, *digest]))


def write_sheet(sheet: Sheet, path: Path) -> None:
    """A contact sheet as a picture of its own; none where nothing was judged."""
    rows = [[tile.text if tile.image is None else tile.image for tile in tiles] for _, tiles in sheet.rows]
    if sheet.columns:
        captions = [column.replace(" (", "\n(") for column in sheet.columns]
        contact_sheet(rows, [label for label, _ in sheet.rows], captions, path)


def truth_finder() -> FindTruth:
    """Finds prepared shapes in the store that a cell was trained from, where that is here."""
    stores: dict[str, Store | None] = {}

    def find(cell: Cell, id: str) -> StoredShape | None:
        config = cell.result.config
        key = str(config.get("data"))
        if key not in stores:
            stores[key] = _store(config)
        store = stores[key]
        return store.get(id) if store else None

    return find


def _store(config: dict[str, Any]) -> Store | None:
    try:
        data = data_of(config)
        folder = Path(data.store) / data.source.name / preparation_hash(data.preparation)
        return Store.open(folder, up=data.source.up)
    except (SdfhubError, KeyError, TypeError, AttributeError):
        return None  # not on this machine: a report without ground truth


def report(config: DictConfig) -> None:
    """The task: `config` as conf/report.yaml has it."""
    sweep = Path(config.sweep)
    if config.shapes < 1:
        raise SdfhubError(f"shapes={config.shapes}: must be at least 1")
    folder = Path(config.out) if config.out else sweep / "report"
    read_plan(sweep)  # what is no sweep gets no folder
    refuse_unwritable(folder)
    cells = write_report(sweep, folder, config.shapes)
    if failed := sum(cell.state == "failed" for cell in cells):
        log.warning("%d of %d cells failed; the command of the sweep tries them again", failed, len(cells))
