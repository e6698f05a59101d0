"""What an evaluation found, for readers: table, `metrics.json`, `metrics.csv`, meshes, contact sheet."""

import csv
import dataclasses
import io
import json
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from sdfhub.data.store.stored_shape import StoredShape
from sdfhub.geometry.contact_sheet import contact_sheet
from sdfhub.geometry.mesh_file import write_mesh
from sdfhub.geometry.mesher import Mesh
from sdfhub.geometry.metrics import ShapeMetrics, summarize
from sdfhub.geometry.render import render
from sdfhub.whole_file import write_whole

log = logging.getLogger(__name__)

COLUMNS = {
    "cd": "CD x10^3",
    "floor": "floor",
    "excess": "excess",
    "normal_consistency": "normals",
    "f_score": "F-score",
}
"""Metrics of the printed table and their headings; the files carry all of them."""


@dataclass(frozen=True)
class Judged:
    """One judged shape: who it is, how good it is and, where it is on the sheet, what it looks like.

    Args:
        role: `train` or `held_out`.
        shape: the truth.
        metrics: of its reconstruction.
        pictures: of the truth and of the reconstruction; words stand for a surface that is not there.
    """

    role: str
    shape: StoredShape
    metrics: ShapeMetrics
    pictures: tuple[np.ndarray, np.ndarray | str] | None


def write_reconstruction(role: str, shape: StoredShape, mesh: Mesh, out: Path) -> None:
    """Writes a reconstruction below `meshes/`, in the frame of the source's own meshes.

    Args:
        role, shape: of which it is one.
        mesh: normalised frame; nothing is written where it has no faces.
        out: folder of the results.
    """
    vertices, faces = mesh
    write_mesh(shape.frame.to_source(vertices), faces, out / "meshes" / role / f"{shape.id}.ply")


def pictured(shape: StoredShape, mesh: Mesh) -> tuple[np.ndarray, np.ndarray | str]:
    """Pictures of a shape and of its reconstruction, normalised frame."""
    truth = render(shape.mesh.vertices, shape.mesh.faces, up=shape.up)
    return truth, render(*mesh, up=shape.up) if len(mesh[1]) else "no surface"


def write_scores(
    judged: Sequence[Judged], evaluation: Any, training: dict[str, Any] | None, out: Path
) -> dict[str, Any]:
    """Writes `metrics.json`, `metrics.csv` and `contact_sheet.png` below `out`; prints the table.

    Args:
        judged: what was judged, in the order of the table.
        evaluation: a dataclass of the settings, kept beside the numbers.
        training: plain numbers about the training, likewise; None where nothing was trained.
        out: folder of the results.

    Returns:
        What `metrics.json` holds: the settings and, per role, a `summary` and the rows of its `shapes`.
    """
    result: dict[str, Any] = {"evaluation": dataclasses.asdict(evaluation), "training": training}
    for role in dict.fromkeys(row.role for row in judged):
        rows = [row for row in judged if row.role == role]
        shapes = [{"id": row.shape.id, **dataclasses.asdict(row.metrics)} for row in rows]
        result[role] = {"summary": summarize([row.metrics for row in rows]), "shapes": shapes}
    write_whole(out / "metrics.csv", _csv(judged))
    if shown := [row for row in judged if row.pictures]:
        _write_sheet(shown, out / "contact_sheet.png")
    write_whole(out / "metrics.json", json.dumps(result, indent=1))  # last: a run that has it is finished
    log.info(table(judged))
    if judged:
        log.info("\nmeshes:        %s", out / "meshes")
    if shown:
        log.info("contact sheet: %s", out / "contact_sheet.png")
    log.info("metrics:       %s", out / "metrics.json")
    return result


def table(judged: Sequence[Judged]) -> str:
    """The Chamfer table: a line a shape, then mean and median, known and held-out shapes apart."""
    width = max([len(row.shape.id) for row in judged] + [len("90th percentile")]) + 2
    lines = []
    for role in dict.fromkeys(row.role for row in judged):
        rows = [row for row in judged if row.role == role]
        title = "training shapes" if role == "train" else "held-out shapes"
        lines += ["", f"{title:<{width}}" + "".join(f"{heading:>11}" for heading in COLUMNS.values())]
        lines += [f"{row.shape.id:<{width}}{_cells(row.metrics)}" for row in rows]
        whole = [row.metrics for row in rows if not row.metrics.failed]
        statistics = {"mean": np.mean, "median": np.median, "90th percentile": partial(np.quantile, q=0.9)}
        for name, statistic in statistics.items() if whole else ():
            values = {key: float(statistic([getattr(m, key) for m in whole])) for key in COLUMNS}
            lines.append(f"{name:<{width}}" + "".join(_number(key, values[key]) for key in COLUMNS))
        lines.append(f"{'without surface':<{width}}{len(rows) - len(whole):>11} of {len(rows)}")
    return "\n".join(lines)


def _cells(metrics: ShapeMetrics) -> str:
    if metrics.failed:
        return f"{'no surface':>11}"
    return "".join(_number(key, getattr(metrics, key)) for key in COLUMNS)


def _number(key: str, value: float) -> str:
    thousandfold = key in ("cd", "floor", "excess")
    return f"{value * 1e3 if thousandfold else value:>11.4f}"


def _csv(judged: Sequence[Judged]) -> str:
    fields = [field.name for field in dataclasses.fields(ShapeMetrics)]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["role", "id", *fields])
    for row in judged:
        writer.writerow([row.role, row.shape.id, *(getattr(row.metrics, field) for field in fields)])
    return text.getvalue()


def _write_sheet(shown: Sequence[Judged], path: Path) -> None:
    """Ground truth above reconstruction; CD times 10^3, as in the table."""
    captions = [f"{row.shape.id}\n{_title(row)}" for row in shown]
    pictures = list(zip(*(row.pictures for row in shown), strict=True))
    contact_sheet(pictures, ["ground truth", "reconstruction"], captions, path)


def _title(row: Judged) -> str:
    cd = "no surface" if row.metrics.failed else f"CD {row.metrics.cd * 1e3:.3f}"
    return f"{row.role.replace('_', '-')}, {cd}"


def write_distances(
    rows: Sequence[tuple[str, StoredShape, dict[str, float]]], training: dict[str, Any] | None, out: Path
) -> dict[str, Any]:
    """The scores of shapes without a mesh: `metrics.json`, `metrics.csv` and a printed table.

    Args:
        rows: role, shape and its distance errors; at least one.
        training: plain numbers about the training; None where nothing was trained.
        out: folder of the results.
    """
    result: dict[str, Any] = {"training": training}
    lines, heads = [["role", "id", *rows[0][2]]], list(rows[0][2])
    for role, shape, errors in rows:
        entry = result.setdefault(role, {"summary": {}, "shapes": []})
        entry["shapes"].append({"id": shape.id, **errors})
        lines.append([role, shape.id, *errors.values()])
    for entry in (result[role] for role in dict.fromkeys(row[0] for row in rows)):
        for head in heads:
            values = [row[head] for row in entry["shapes"]]
            entry["summary"][head] = {"mean": float(np.mean(values)), "median": float(np.median(values))}
    write_whole(out / "metrics.csv", "".join(",".join(map(str, line)) + "\n" for line in lines))
    write_whole(out / "metrics.json", json.dumps(result, indent=1))  # last: a run that has it is finished
    log.info("\nthis source holds no meshes: judged by signed distances, not by surfaces")
    for line in lines:
        log.info("  ".join(f"{cell:<14.5f}" if isinstance(cell, float) else f"{cell:<14}" for cell in line))
    log.info("metrics:       %s", out / "metrics.json")
    return result
