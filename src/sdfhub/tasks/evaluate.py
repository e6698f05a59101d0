"""Task `evaluate`: a trained shape space is meshed, judged and shown, known and held-out shapes apart."""

import csv
import dataclasses
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from omegaconf import DictConfig
from torch import Tensor
from tqdm import tqdm

from sdfhub.data.datamodule import Augmentation, StepBatches
from sdfhub.data.shards import StoredShape
from sdfhub.errors import SdfhubError
from sdfhub.geometry.contact_sheet import contact_sheet
from sdfhub.geometry.mesher import mesh_field
from sdfhub.geometry.metrics import ShapeMetrics, judge, summarize
from sdfhub.geometry.render import render
from sdfhub.model.autodecoder import AutoDecoder
from sdfhub.model.decoder import Decoder
from sdfhub.model.fitting import MapFit
from sdfhub.shapes import NormalizedMesh
from sdfhub.tasks.app import run_task
from sdfhub.tasks.build import build, check, plain
from sdfhub.tasks.prepare import prepare_data
from sdfhub.tasks.run import load_autodecoder, read_run, write_text

COLUMNS = {
    "cd": "CD x10^3",
    "floor": "floor",
    "excess": "excess",
    "normal_consistency": "normals",
    "f_score": "F-score",
}
"""Metrics of the printed table and their headings; the files carry all of them."""


@dataclass(frozen=True)
class Evaluation:
    """How a shape space is judged.

    Args:
        resolution: points along an axis of the marching-cubes grid.
        points: surface points a side for Chamfer distance and F-score.
        known: training shapes to judge, from the front of the table; None judges all.
        held_out: held-out shapes to judge; None judges all.
        fit: how codes of held-out shapes are found.
        fit_together: held-out shapes fitted side by side.
        pictures: shapes of each role on the contact sheet.
        seed: of every draw.
    """

    resolution: int
    points: int
    known: int | None
    held_out: int | None
    fit: MapFit
    fit_together: int
    pictures: int
    seed: int = 0

    def __post_init__(self):
        if min(self.resolution, self.points, self.fit_together) < 2 and self.fit_together < 1:
            raise ValueError("evaluate: resolution and points must be at least 2, fit_together 1")


@dataclass(frozen=True)
class Judged:
    """One judged shape: who it is, how good it is, and what it looks like in the normalised frame."""

    role: str
    shape: StoredShape
    metrics: ShapeMetrics
    vertices: np.ndarray
    faces: np.ndarray


def evaluate_model(
    model: AutoDecoder,
    train: Sequence[StoredShape],
    held_out: Sequence[StoredShape],
    evaluation: Evaluation,
    out: Path,
) -> dict[str, Any]:
    """Judges known and held-out shapes; writes metrics, meshes and the contact sheet below `out`; prints.

    Returns:
        What `metrics.json` holds: per role a `summary` and the rows of its `shapes`.
    """
    known, unseen = list(train)[: evaluation.known], list(held_out)[: evaluation.held_out]
    model.eval()
    with torch.inference_mode():
        codes = model.codes(torch.arange(len(known), device=model.device))
    judged = [_judge("known", *pair, model.decoder, evaluation) for pair in _bar(known, codes, "judging known")]
    if unseen:
        codes = fit_held_out(model.decoder, unseen, evaluation)
        pairs = _bar(unseen, codes, "judging held-out")
        judged += [_judge("held_out", *pair, model.decoder, evaluation) for pair in pairs]
    return report(judged, evaluation, out)


def fit_held_out(decoder: Decoder, shapes: Sequence[StoredShape], evaluation: Evaluation) -> Tensor:
    """Codes [S, L] of shapes that were never trained on, from their signed samples."""
    fitted = []
    groups = range(0, len(shapes), evaluation.fit_together)
    for start in tqdm(groups, desc="fitting held-out", unit="group", leave=False):
        group = list(shapes[start : start + evaluation.fit_together])
        batches = StepBatches(
            group, len(group), evaluation.fit.samples, 0, Augmentation(), seed=evaluation.seed
        )
        draw = partial(_in_order, batches)
        fitted.append(evaluation.fit(decoder, draw, len(group), seed=evaluation.seed))
    return torch.cat(fitted)


def _in_order(batches: StepBatches, step: int) -> tuple[Tensor, Tensor]:
    """A step's points [B, N, 3] and distances [B, N] with the shapes in their own order."""
    batch = batches[step]
    order = batch.rows.argsort()
    return batch.points[order], batch.sdf[order]


def _bar(shapes: Sequence[StoredShape], codes: Tensor, what: str):
    return tqdm(list(zip(shapes, codes, strict=True)), desc=what, unit="shape", leave=False)


def _judge(role: str, shape: StoredShape, code: Tensor, decoder: Decoder, evaluation: Evaluation) -> Judged:
    truth = shape.mesh
    if truth is None:
        raise SdfhubError(
            f"{shape.id}: this data source holds no meshes, so there is no surface to compare with; "
            "train with evaluate=none"
        )
    vertices, faces = reconstruct(decoder, code, evaluation.resolution)
    metrics = judge((vertices, faces), truth, points=evaluation.points, seed=evaluation.seed)
    return Judged(role, shape, metrics, vertices, faces)


def reconstruct(decoder: Decoder, code: Tensor, resolution: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] and faces [F, 3] of the zero level of f(., z), normalised frame; empty without one.

    Args:
        decoder: in evaluation mode.
        code: [L].
        resolution: points along an axis of the grid.
    """
    return mesh_field(lambda x: decoder(x[None], code[None])[0], resolution=resolution, device=code.device)


def report(judged: Sequence[Judged], evaluation: Evaluation, out: Path) -> dict[str, Any]:
    """Writes `metrics.json`, `metrics.csv`, `meshes/` and `contact_sheet.png`; prints the table."""
    result: dict[str, Any] = {"evaluation": dataclasses.asdict(evaluation)}
    for role in dict.fromkeys(row.role for row in judged):
        rows = [row for row in judged if row.role == role]
        shapes = [{"id": row.shape.id, **dataclasses.asdict(row.metrics)} for row in rows]
        result[role] = {"summary": summarize([row.metrics for row in rows]), "shapes": shapes}
    write_text(out / "metrics.json", json.dumps(result, indent=1))
    write_text(out / "metrics.csv", _csv(judged))
    for row in judged:
        _write_mesh(row, out / "meshes" / row.role / f"{row.shape.id}.ply")
    _write_sheet(judged, evaluation.pictures, out / "contact_sheet.png")
    print(table(judged))
    print(f"\nmeshes:        {out / 'meshes'}\ncontact sheet: {out / 'contact_sheet.png'}")
    print(f"metrics:       {out / 'metrics.json'}\nTensorBoard:   tensorboard --logdir {out}")
    return result


def table(judged: Sequence[Judged]) -> str:
    """The Chamfer table: a line a shape, then mean and median, known and held-out shapes apart."""
    width = max([len(row.shape.id) for row in judged] + [len("90th percentile")]) + 2
    lines = []
    for role in dict.fromkeys(row.role for row in judged):
        rows = [row for row in judged if row.role == role]
        title = "known shapes" if role == "known" else "held-out shapes"
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


def _write_mesh(row: Judged, path: Path) -> None:
    """The reconstruction as PLY, back in its source's frame; nothing where there is no surface."""
    if not len(row.faces):
        return
    vertices = row.vertices / row.shape.scale + row.shape.center
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_suffix(".part.ply")
    trimesh.Trimesh(vertices, row.faces, process=False).export(beside)
    beside.replace(path)


def _write_sheet(judged: Sequence[Judged], pictures: int, path: Path) -> None:
    """Ground truth above reconstruction, known shapes first."""
    shown = [row for role in ("known", "held_out") for row in [r for r in judged if r.role == role][:pictures]]
    truth = [_picture(row.shape.mesh) for row in shown]
    ours = [render(row.vertices, row.faces) if len(row.faces) else None for row in shown]
    captions = [f"{row.shape.id} ({row.role.replace('_', ' ')})" for row in shown]
    contact_sheet([truth, ours], ["ground truth", "reconstruction"], captions, path)


def _picture(mesh: NormalizedMesh) -> np.ndarray:
    return render(mesh.vertices, mesh.faces)


def main() -> None:
    """Console entry: `sdfhub evaluate run=RUN evaluate.resolution=512`."""

    def task(config: DictConfig) -> None:
        evaluate_run(plain(config))

    run_task(task, "evaluate")


def evaluate_run(config: dict[str, Any]) -> dict[str, Any]:
    """Judges a finished run again, as `config` says, into `RUN/evaluation` or `out`."""
    run = Path(check(config["run"], str, "run"))
    trained, split = read_run(run)
    evaluation = build(config["evaluate"], "evaluate")
    prepared = prepare_data(trained["data"] | config["data"])
    known = [prepared.store[id] for id in split["train"]]
    unseen = [shape for shape in prepared.held_out if shape.id not in set(split["train"])]
    augmentation = trained["data"]["loader"]["augmentation"]
    model = load_autodecoder(run, trained, rows=len(known) * (1 + augmentation["copies"]))
    return evaluate_model(model, known, unseen, evaluation, Path(config["out"] or run / "evaluation"))
