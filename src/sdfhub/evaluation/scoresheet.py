"""What an evaluation measured, for readers: table, `metrics.json`, `metrics.csv`, meshes, contact sheet."""

import json
import logging
from collections.abc import Sequence
from dataclasses import asdict
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sdfhub.data.store.stored_shape import StoredShape
from sdfhub.geometry.metrics import DistanceMetrics, ShapeMetrics, summarize
from sdfhub.geometry.picture_file import contact_sheet
from sdfhub.whole_file import write_whole

log = logging.getLogger(__name__)

COLUMNS = {  # of the printed table: headings and factors; files carry all metrics, without factors
    "cd": ("CD x10^3", 1e3),
    "floor": ("floor", 1e3),
    "excess": ("excess", 1e3),
    "normal_consistency": ("normals", 1),
    "f_score": ("F-score", 1),
    "sdf_error": ("|f-d| x10^3", 1e3),
    "sign_accuracy": ("signs right", 1),
}

TITLES = {"train": "training shapes", "held_out": "held-out shapes"}


class Judged(NamedTuple):
    """One judged shape; `pictures` of those on the contact sheet."""

    role: str  # `train` or `held_out`
    shape: StoredShape
    metrics: ShapeMetrics | DistanceMetrics
    pictures: tuple[np.ndarray, np.ndarray | str] | None = None  # truth, reconstruction; words: no surface


def write_scores(
    judged: Sequence[Judged], evaluation: Any, training: dict[str, Any] | None, out: Path
) -> dict[str, Any]:
    """Writes `metrics.csv`, `contact_sheet.png` and, which is returned, `metrics.json`; prints the table."""
    import pandas  # here: slow to import, and every training would wait for it before its first step

    result: dict[str, Any] = {"evaluation": asdict(evaluation), "training": training}
    for role, rows in _by_role(judged).items():
        shapes = [{"id": row.shape.id, **asdict(row.metrics)} for row in rows]
        result[role] = {"summary": summarize([row.metrics for row in rows]), "shapes": shapes}
    table_rows = [{"role": row.role, "id": row.shape.id, **asdict(row.metrics)} for row in judged]
    write_whole(out / "metrics.csv", pandas.DataFrame(table_rows).to_csv(index=False))
    log.info(table(judged))
    if any(isinstance(row.metrics, DistanceMetrics) for row in judged):
        log.info("\nthis source holds no meshes: judged by signed distances, not by surfaces")
    if drawn := [row for row in judged if row.pictures]:
        write_sheet(drawn, out / "contact_sheet.png")
    write_whole(out / "metrics.json", json.dumps(result, indent=1, default=str))  # last: the run is finished
    log.info("\nscores, meshes and contact sheet: %s", out)
    return result


def write_sheet(drawn: Sequence[Judged], path: Path) -> None:
    """Draws shapes that have pictures, those of each role side by side: ground truth above reconstruction."""
    roles = _by_role(drawn).values()
    columns, rows, captions = max(map(len, roles)), list[Any](), list[str]()
    for shapes in roles:
        rows += zip(*[shape.pictures for shape in shapes if shape.pictures], strict=True)
        captions += [*map(_caption, shapes), *[""] * (2 * columns - len(shapes))]
    contact_sheet(rows, ["ground truth", "reconstruction"] * len(roles), captions, path)


def table(judged: Sequence[Judged]) -> str:
    """A line a shape, then mean, median and 90th percentile, training and held-out shapes apart."""
    import pandas

    blocks = []
    for role, rows in _by_role(judged).items():
        scores = pandas.DataFrame([asdict(row.metrics) for row in rows], [row.shape.id for row in rows])
        columns = {name: column for name, column in COLUMNS.items() if name in scores}
        frame = scores[list(columns)].astype(float) * [factor for _, factor in columns.values()]
        failed = [getattr(row.metrics, "failed", False) for row in rows]
        frame.columns = pandas.Index([heading for heading, _ in columns.values()], name=TITLES[role])
        frame.loc[failed] = np.nan
        summary = frame.agg(["mean", "median"])
        summary.loc["90th percentile"] = frame.quantile(0.9)
        text = pandas.concat([frame, summary]).to_string(float_format="{:.4f}".format, na_rep="-")
        blocks.append(f"{text}\nwithout surface: {sum(failed)} of {len(rows)}")
    return "\n\n".join(blocks)


def _by_role(judged: Sequence[Judged]) -> dict[str, list[Judged]]:
    return {role: list(rows) for role, rows in groupby(judged, lambda row: row.role)}


def _caption(row: Judged) -> str:
    cd = getattr(row.metrics, "cd", None)
    return f"{row.shape.id}\n{row.role}, {'no surface' if cd is None else f'CD {cd * 1e3:.3f}'}"
