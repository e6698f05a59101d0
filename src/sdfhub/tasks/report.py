"""Task `report`: a sweep's folder becomes tables, claims and one page that opens offline."""

from functools import cache
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from sdfhub.data.shards import StoredShape
from sdfhub.data.store import Store, preparation_hash
from sdfhub.errors import SdfhubError
from sdfhub.geometry.contact_sheet import contact_sheet
from sdfhub.report.formats import csv_text, latex, markdown
from sdfhub.report.meshes import FindTruth
from sdfhub.report.origin import origin_table
from sdfhub.report.page import page
from sdfhub.report.pictures import Gallery, Sheet
from sdfhub.report.plan import read_plan
from sdfhub.report.results import read_sweep
from sdfhub.report.rows import Group, group_cells
from sdfhub.report.tables import claims_table, tables
from sdfhub.tasks.app import first_word_as, run_task
from sdfhub.tasks.build import build, check, plain
from sdfhub.tasks.run import refuse_unwritable
from sdfhub.whole_file import write_whole


def write_report(sweep: Path, out: Path, shapes: int = 6) -> None:
    """Writes `table.md`, `.tex` and `.csv`, a contact sheet a group and `report.html`; prints the tables.

    Args:
        sweep: folder of a multirun, finished or not.
        out: folder of the report.
        shapes: pictured side by side.

    Raises:
        SdfhubError: not a sweep's folder.
    """
    cells = read_sweep(sweep)
    groups = group_cells(cells)
    all_tables = [table for group in groups for table in tables(group)]
    print("\n" + markdown(all_tables))
    claims = [claims_table(group) for group in groups]
    origin = origin_table(read_plan(sweep).commands, cells)
    write_whole(out / "table.md", f"# {sweep.name}\n\n{markdown([*all_tables, *claims, origin])}")
    write_whole(out / "table.tex", latex(all_tables))
    write_whole(out / "table.csv", csv_text(groups))
    gallery = Gallery(truth_finder(groups))
    for group in groups:
        write_sheet(gallery.sheet(group, shapes), out / f"{'_'.join(['sheet', *group.choices.values()])}.png")
    write_whole(out / "report.html", page(sweep.name, cells, groups, origin, gallery, shapes))
    print(f"report: {out / 'report.html'}", flush=True)


def write_sheet(sheet: Sheet, path: Path) -> None:
    """A contact sheet as a picture of its own; none where nothing was judged."""
    rows = [[tile.alt if tile.image is None else tile.image for tile in tiles] for _, tiles in sheet.rows]
    if rows:
        captions = [column.replace(" (", "\n(") for column in sheet.columns]
        contact_sheet(rows, [label for label, _ in sheet.rows], captions, path)


def truth_finder(groups: list[Group]) -> FindTruth:
    """Finds prepared shapes in the stores that the cells were trained from, as far as they are here."""
    configs = [cell.scores.config for group in groups for row in group.rows for cell in row.done]
    stores = {id(config): _store(config) for config in _one_per_store(configs)}

    @cache
    def find(id: str) -> StoredShape | None:
        return next((store[id] for store in stores.values() if store and id in store), None)

    return find


def _one_per_store(configs: list[dict]) -> list[dict]:
    keys = ("source", "preparation", "store")
    return list({str([config["data"].get(key) for key in keys]): config for config in configs}.values())


def _store(config: dict[str, Any]) -> Store | None:
    try:
        data = config["data"]
        source = build(data["source"], "data.source", within="sdfhub.data.sources")
        preparation = build(data["preparation"], "data.preparation", within="sdfhub.data")
        store = Store.open(Path(data["store"]) / source.name / preparation_hash(preparation))
    except (SdfhubError, KeyError, TypeError, AttributeError):
        return None  # not on this machine: a report without ground truth
    for shape in store:
        shape.up = source.up
    return store


def report(config: dict[str, Any]) -> None:
    """The task: `config` as conf/report.yaml has it."""
    sweep = Path(check(config["sweep"], str, "sweep"))
    out = check(config["out"], str | None, "out")
    shapes = check(config["shapes"], int, "shapes")
    if shapes < 1:
        raise SdfhubError(f"shapes={shapes}: must be at least 1")
    folder = Path(out) if out else sweep / "report"
    refuse_unwritable(folder)
    write_report(sweep, folder, shapes)


def main() -> None:
    """Console entry: `sdfhub report SWEEP_DIR [out=... shapes=...]`."""
    first_word_as("sweep")

    def task(config: DictConfig) -> None:
        report(plain(config))

    run_task(task, "report")
