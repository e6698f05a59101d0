"""Task `evaluate`: a trained shape space is meshed and judged, known and held-out shapes apart."""

import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig
from torch import Tensor
from tqdm import tqdm

from sdfhub.data.loading import SdfDataModule
from sdfhub.data.loading.batches import draw_rows, signed_samples
from sdfhub.data.sources import Source
from sdfhub.data.splits import Split, split
from sdfhub.data.store.store import shape_seed
from sdfhub.data.store.stored_shape import StoredShape
from sdfhub.data.workers import stream_in_processes
from sdfhub.errors import SdfhubError
from sdfhub.geometry.mesher import Mesh
from sdfhub.geometry.metrics import Judge
from sdfhub.latent.fitting import Fit
from sdfhub.model.decoder import Decoder
from sdfhub.model.fast.computing import distances
from sdfhub.shapes import NormalizedMesh
from sdfhub.space import reconstruct
from sdfhub.tasks.app import run_task
from sdfhub.tasks.build import build, check, plain
from sdfhub.tasks.opening import load
from sdfhub.tasks.run import read_run, refuse_unwritable
from sdfhub.tasks.scoresheet import Judged, pictured, write_distances, write_reconstruction, write_scores

WORTH_A_PROCESS = 4
"""Shapes to judge for which a worker process is started: it takes as long to start as to judge one or two."""

NOISE = 64
"""Faces, in squared resolutions, above which a mesh is noise: ten times those of the unit sphere. What a
training that diverged leaves crosses zero in every cell: it is no surface, and would take gigabytes."""


@dataclass(frozen=True)
class Evaluation:
    """How a shape space is judged.

    Args:
        resolution: points along an axis of the marching-cubes grid, >= 2.
        points: surface points a side for Chamfer distance and F-score, >= 1.
        known: training shapes to judge, from the front of the code table; None judges all.
        held_out: held-out shapes to judge; None judges all.
        fit: how codes of held-out shapes are found.
        fit_together: held-out shapes fitted side by side, >= 1.
        pictures: shapes of each role on the contact sheet.
        workers: processes that judge, >= 0; None for one per core.
        seed: of every draw.
    """

    resolution: int
    points: int
    known: int | None
    held_out: int | None
    fit: Fit
    fit_together: int
    pictures: int
    workers: int | None = None
    seed: int = 0

    def __post_init__(self):
        if self.resolution < 2 or min(self.points, self.fit_together) < 1:
            raise ValueError("resolution must be at least 2, points and fit_together at least 1")
        if min(self.known or 0, self.held_out or 0, self.pictures, self.workers or 0, self.seed) < 0:
            raise ValueError("known, held_out, pictures, workers and seed must not be negative")


def build_evaluation(node: dict[str, Any], loss: dict[str, Any]) -> Evaluation:
    """How a run is judged. Codes are fitted under the clamp of the training.

    Args:
        node: config of the evaluation.
        loss: config of the loss that the run was, or is to be, trained with.

    Raises:
        SdfhubError: a setting is wrong.
    """
    delta = check(loss["delta"], float, "loss.delta")
    return build(node | {"fit": node["fit"] | {"delta": delta}}, "evaluate")


def evaluate_model(
    decoder: Decoder,
    codes: Tensor,
    train: Mapping[int, StoredShape],
    held_out: Sequence[StoredShape],
    evaluation: Evaluation,
    out: Path,
    training: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Judges known and held-out shapes; writes what it found below `out` and prints the table.

    Shapes without a mesh (DeepSDF's npz files) are judged by their signed distances alone.

    Args:
        decoder: trained.
        codes: [S, L] code table.
        train: shapes that it was trained on, by row of the table.
        held_out: shapes that it has not seen.
        evaluation: how to judge.
        out: folder of the results.
        training: plain numbers about the training, to be kept beside the scores.

    Returns:
        What `metrics.json` holds.
    """
    decoder.eval()
    known, unseen = list(train.items())[: evaluation.known], list(held_out)[: evaluation.held_out]
    roles = [("known", shape, codes[row]) for row, shape in known]
    if unseen:
        fitted = fit_held_out(decoder, unseen, evaluation)
        roles += [("held_out", shape, code) for shape, code in zip(unseen, fitted, strict=True)]
    if any(shape.mesh is None for _, shape, _ in roles):
        delta = evaluation.fit.delta
        rows = [(role, shape, distance_errors(decoder, code, shape, delta)) for role, shape, code in roles]
        return write_distances(rows, training, out)
    return write_scores(judge_all(decoder, roles, evaluation, out), evaluation, training, out)


def fit_held_out(decoder: Decoder, shapes: Sequence[StoredShape], evaluation: Evaluation) -> Tensor:
    """Codes [S, L] of shapes that were never trained on, from their signed samples."""
    fitted = []
    for start in range(0, len(shapes), evaluation.fit_together):
        group = list(shapes[start : start + evaluation.fit_together])
        seeds = [shape_seed(shape) ^ evaluation.seed for shape in group]
        draw = partial(_drawn, group, seeds, evaluation.fit.samples)
        fitted.append(evaluation.fit(decoder, draw, seeds))
    return torch.cat(fitted)


def _drawn(shapes: list[StoredShape], seeds: list[int], samples: int, step: int) -> tuple[Tensor, Tensor]:
    """A step's points [B, N, 3] and distances [B, N]; a shape's draw depends on its own seed alone."""
    rows = [
        signed_samples(shape, samples, np.random.default_rng((seed, step)))
        for shape, seed in zip(shapes, seeds, strict=True)
    ]
    drawn = torch.from_numpy(np.stack(rows))
    return drawn[..., :3], drawn[..., 3]


def judge_all(
    decoder: Decoder,
    roles: Sequence[tuple[str, StoredShape, Tensor]],
    evaluation: Evaluation,
    out: Path,
) -> list[Judged]:
    """Reconstructs shapes one after another, while worker processes judge those before.

    A mesh is written and drawn when it is made, and not kept: a thousand would not fit into memory.

    Args:
        decoder: in evaluation mode.
        roles: role, shape and code [L] of each.
        evaluation: how to judge; its `workers` change speed, not scores.
        out: folder of the results, for the meshes.
    """
    pictures, of_role = [], Counter()

    def pairs() -> Iterator[tuple[Mesh, NormalizedMesh]]:
        for role, shape, code in tqdm(roles, desc="judging", unit="shape", leave=False, disable=None):
            (mesh,) = reconstruct(decoder, code[None], evaluation.resolution)
            mesh = _resolved(shape, mesh, evaluation.resolution)
            write_reconstruction(role, shape, mesh, out)
            of_role[role] += 1
            pictures.append(pictured(shape, mesh) if of_role[role] <= evaluation.pictures else None)
            yield mesh, shape.mesh

    workers = (os.cpu_count() or 1) if evaluation.workers is None else evaluation.workers
    workers = min(workers, len(roles) // WORTH_A_PROCESS)
    metrics = stream_in_processes(Judge(evaluation.points, evaluation.seed), pairs(), workers)
    return [
        Judged(role, shape, row, drawn)
        for (role, shape, _), row, drawn in zip(roles, list(metrics), pictures, strict=True)
    ]


def _resolved(shape: StoredShape, mesh: Mesh, resolution: int) -> Mesh:
    """The mesh, or none where it is noise."""
    vertices, faces = mesh
    if len(faces) <= NOISE * resolution**2:
        return mesh
    print(f"{shape.id}: its field is noise, {len(faces):,} faces: counts as no surface", flush=True)
    return vertices[:0], faces[:0]


@torch.inference_mode()
def distance_errors(decoder: Decoder, code: Tensor, shape: StoredShape, delta: float) -> dict[str, float]:
    """How far the field is from a shape's own samples, up to 100,000 a side.

    Returns:
        `sdf_error`: mean |f - d| over samples with |d| < delta, normalised units; `sign_accuracy`: share of
        samples on the right side.
    """
    rng = np.random.default_rng(0)
    counts = {name: min(shape.rows(name), 100_000) for name in ("outside", "inside")}
    drawn = np.empty((sum(counts.values()), 4), np.float32)
    for part, name in zip(np.split(drawn, [counts["outside"]]), counts, strict=True):
        draw_rows(part, shape, name, rng)
    rows = torch.from_numpy(drawn).to(code.device)
    field = distances(decoder, rows[None, :, :3], code[None])[0]
    near = rows[:, 3].abs() < delta
    return {
        "sdf_error": float((field - rows[:, 3]).abs()[near].mean()),
        "sign_accuracy": float(((field < 0) == (rows[:, 3] < 0)).float().mean()),
    }


def evaluate_run(config: dict[str, Any]) -> dict[str, Any]:
    """Judges a finished run again, as `config` says, into `out` or a folder `evaluation` of the run."""
    run = Path(check(config["run"], str, "run"))
    out = check(config["out"], Path | None, "out") or run / "evaluation"
    trained, roles_then = read_run(run)
    evaluation = build_evaluation(config["evaluate"], trained["loss"])
    space = load(run)
    refuse_unwritable(out)
    asked = {key: config["data"].get(key) for key in ("source", "store", "workers")}
    data = trained["data"] | {key: value for key, value in asked.items() if value is not None}
    loader: SdfDataModule = build(data, "data", within="sdfhub.data")
    source = loader.source
    then = build(trained["data"]["source"], "data.source", within="sdfhub.data.sources")
    # under other settings (categories, count) a source of the same name offers shapes of the same ids
    seen = set(roles_then["train"]) if source.name == then.name else set()
    is_same = data["source"] == trained["data"]["source"]
    roles = choose_shapes(source, roles_then if is_same else {"train": [], "held_out": []}, seen, config)
    print(f"shapes: {len(roles.train)} known, {len(roles.held_out)} held out", flush=True)
    train, held_out = loader.prepared(roles)
    known = {roles_then["train"].index(shape.id): shape for shape in train}
    return evaluate_model(space.decoder, space.codes, known, held_out, evaluation, out)


def choose_shapes(
    source: Source, trained: dict[str, list[str]], seen: set[str], config: dict[str, Any]
) -> Split:
    """The shapes to judge: those of the run, those that `shapes` names, or `held_out` unseen ones.

    Args:
        source: offers them.
        trained: ids by role in the run; none where another source or other settings of it are judged.
        seen: ids that were trained on: never judged as unseen ones.
        config: the task's.

    Raises:
        SdfhubError: a shape that the source does not have.
    """
    offered = {shape.id: shape for shape in source.shapes()}
    ids = check(config["shapes"], list[str] | None, "shapes")
    count = check(config["held_out"], int | None, "held_out")
    unseen = [id for id in offered if id not in seen]
    known = trained["train"]
    if ids is not None:
        known, unseen = [id for id in ids if id in known], [id for id in ids if id not in known]
        if trained_on := seen.intersection(unseen):
            raise SdfhubError(
                f"shapes: {min(trained_on)} was trained on; leave out data= to judge it as known"
            )
    elif trained["train"] and count is None:
        unseen = trained["held_out"]
    elif count is not None:
        unseen = [shape.id for shape in split([offered[id] for id in unseen], 0, count, seed=0).held_out]
    for id in (*known, *unseen):
        if id not in offered:
            raise SdfhubError(
                f"shapes: {source.name} has no shape {id!r}; it has {', '.join(list(offered)[:3])} ..."
            )
    return Split([offered[id] for id in known], [offered[id] for id in unseen])


def main() -> None:
    """Console entry: `sdfhub evaluate run=RUN evaluate.resolution=512`."""

    def task(config: DictConfig) -> None:
        evaluate_run(plain(config))

    run_task(task, "evaluate")
