"""Task `report`: a sweep's folder becomes tables, pictures and one page that opens offline."""

import base64
import hashlib
import re
from contextlib import suppress
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from omegaconf import DictConfig
from pydantic import Field

from sdfhub.data.store.store import Store, preparation_hash
from sdfhub.data.store.stored_shape import StoredShape
from sdfhub.described import check
from sdfhub.errors import SdfhubError
from sdfhub.geometry.picture_file import contact_sheet
from sdfhub.opening import data_of
from sdfhub.report.pictures import FindTruth, contact_sheet_of, loss_chart, picture_uri
from sdfhub.report.results import Cell, read_plan, read_sweep
from sdfhub.report.rows import JUDGING_GROUPS, Group, group_cells, shapes_csv, table_csv
from sdfhub.report.tables import Table, latex, markdown, origin, overview, tables
from sdfhub.whole_file import refuse_unwritable, write_whole


def write_report(sweep: Path, out: Path, shapes: int = 6) -> None:
    """Writes tables, sheets of so many shapes and `report.html`; prints the tables."""
    cells = read_sweep(sweep)
    groups, find_truth = group_cells(cells), truth_finder()
    before, after = overview(groups), [origin(read_plan(sweep).commands, cells)]
    parts: list[dict[str, Any]] = []
    for group in groups:
        sheet = contact_sheet_of(group, shapes, find_truth)
        if sheet.shapes:  # else nothing was judged
            pictures = [[t.text if t.image is None else t.image for t in tiles] for _, tiles in sheet.rows]
            captions = [column.replace(" (", "\n(") for column in sheet.columns]
            labels = [label for label, _ in sheet.rows]
            contact_sheet(pictures, labels, captions, out / f"{sheet_name(group)}.png")
        part = {"title": ", ".join(group.title), "tables": tables(group), "sheet": sheet}
        parts.append(part | {"chart": loss_chart(group)})
    sections: list[tuple[str, list[Table]]] = [("All tables", before)] if before else []
    sections += [*((part["title"], part["tables"]) for part in parts), ("Origin", after)]
    text = "\n".join(markdown(title, part) for title, part in sections)
    print(f"\n{text}")
    write_whole(out / "table.md", f"# {sweep.name}\n\n{text}")
    write_whole(out / "table.tex", latex(sections))
    write_whole(out / "table.csv", table_csv(groups))
    write_whole(out / "shapes.csv", shapes_csv(groups))
    write_whole(out / "report.html", page(name=sweep.name, overview=before, parts=parts, origin=after))
    print(f"report: {out / 'report.html'}", flush=True)


def page(**content: Any) -> str:
    """The page: text is escaped, and its policy lets no request out."""
    script = (files("sdfhub.report") / "viewer.js").read_text("utf-8")
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    loader = PackageLoader("sdfhub.report", ".")
    environment = Environment(loader=loader, autoescape=True, undefined=StrictUndefined)
    content |= {"script": Markup(script), "script_hash": Markup(f"sha256-{digest}"), "uri": picture_uri}
    return environment.get_template("page.html.j2").render(content)


def sheet_name(group: Group) -> str:
    """A name of its own for each group of a sweep."""
    words = ["sheet", *(group.judging[name] for name in JUDGING_GROUPS if name in group.judging)]
    if group.settings:
        words.append(hashlib.sha256(";".join(sorted(group.settings)).encode()).hexdigest()[:8])
    return re.sub(r"[^A-Za-z0-9._-]", "-", "_".join(words))


def truth_finder() -> FindTruth:
    """Finds prepared shapes in the store that a cell was trained from, where that is here."""
    stores: dict[Path, Store] = {}

    def find(cell: Cell, id: str) -> StoredShape | None:
        with suppress(SdfhubError, KeyError, TypeError, AttributeError):  # not on this machine, or no config
            if cell.folder not in stores:
                data = data_of(cell.scores.config)
                folder = Path(data.store) / data.source.name / preparation_hash(data.preparation)
                stores[cell.folder] = Store.open(folder, up=data.source.up)
            return stores[cell.folder].get(id)
        return None

    return find


def report(config: DictConfig) -> None:
    """The task: `config` as conf/report.yaml has it."""
    sweep = Path(config.sweep)
    check(config.shapes, Annotated[int, Field(ge=1)], "shapes")
    folder = Path(config.out) if config.out else sweep / "report"
    read_plan(sweep)  # what is no sweep gets no folder
    refuse_unwritable(folder)
    write_report(sweep, folder, config.shapes)
