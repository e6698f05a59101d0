"""A trained shape space is meshed and judged, training and held-out shapes apart."""

import logging
import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from sdfhub.data.loading.batches import draw_rows
from sdfhub.data.store.store import shape_seed
from sdfhub.data.store.stored_shape import StoredShape
from sdfhub.data.workers import stream_in_processes
from sdfhub.evaluation.scoresheet import (
    Judged,
    pictured,
    write_distances,
    write_reconstruction,
    write_scores,
)
from sdfhub.geometry.mesher import Mesh
from sdfhub.geometry.metrics import Judge
from sdfhub.latent.fitting import Fit
from sdfhub.model.decoder import Decoder
from sdfhub.model.fast.computing import distances
from sdfhub.scans.observed_scan import observations_of
from sdfhub.shapes import NormalizedMesh
from sdfhub.space import reconstruct

log = logging.getLogger(__name__)

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
        train: training shapes to judge, from the front of the code table; None judges all.
        held_out: held-out shapes to judge; None judges all.
        fit: how codes of held-out shapes are found.
        fit_together: held-out shapes fitted side by side, >= 1.
        pictures: shapes of each role on the contact sheet.
        workers: processes that judge, >= 0; None for one per core.
        seed: of every draw.
    """

    resolution: int
    points: int
    train: int | None
    held_out: int | None
    fit: Fit
    fit_together: int
    pictures: int
    workers: int | None = None
    seed: int = 0

    def __post_init__(self):
        if self.resolution < 2 or min(self.points, self.fit_together) < 1:
            raise ValueError("resolution must be at least 2, points and fit_together at least 1")
        if min(self.train or 0, self.held_out or 0, self.pictures, self.workers or 0, self.seed) < 0:
            raise ValueError("train, held_out, pictures, workers and seed must not be negative")


def evaluate_model(
    decoder: Decoder,
    codes: Tensor,
    delta: float,
    train: Mapping[int, StoredShape],
    held_out: Sequence[StoredShape],
    evaluation: Evaluation,
    out: Path,
    training: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Judges training and held-out shapes; writes tables, meshes and pictures below `out`.

    Shapes without a mesh (DeepSDF's npz files) are judged by their signed distances alone.

    Args:
        decoder: trained.
        codes: [S, L] code table.
        delta: clamp of distances that the decoder was trained with; codes are fitted under the same.
        train: shapes that it was trained on, by row of the table.
        held_out: shapes that it has not seen.
        evaluation: how to judge.
        out: folder of the results.
        training: plain numbers about the training, to be kept beside the scores.

    Returns:
        What `metrics.json` holds.
    """
    decoder.eval()
    roles = [("train", shape, codes[row]) for row, shape in list(train.items())[: evaluation.train]]
    if unseen := list(held_out)[: evaluation.held_out]:
        fitted = fit_held_out(decoder, codes, delta, unseen, evaluation)
        roles += [("held_out", shape, code) for shape, code in zip(unseen, fitted, strict=True)]
    if any(shape.mesh is None for _, shape, _ in roles):
        rows = [(role, shape, distance_errors(decoder, code, shape, delta)) for role, shape, code in roles]
        return write_distances(rows, training, out)
    return write_scores(judge_all(decoder, roles, evaluation, out), evaluation, training, out)


def fit_held_out(
    decoder: Decoder, codes: Tensor, delta: float, shapes: Sequence[StoredShape], evaluation: Evaluation
) -> Tensor:
    """Codes [S, L] of shapes that were never trained on, from their signed samples."""
    fitted = []
    for start in range(0, len(shapes), evaluation.fit_together):
        group = shapes[start : start + evaluation.fit_together]
        seeds = [shape_seed(shape) ^ evaluation.seed for shape in group]
        observations = observations_of(group, evaluation.fit.samples, seeds)
        fitted.append(evaluation.fit(decoder, codes, observations, delta).codes)
    return torch.cat(fitted)


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
    log.warning("%s: its field is noise, %s faces: counts as no surface", shape.id, f"{len(faces):,}")
    return Mesh(vertices[:0], faces[:0])


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
