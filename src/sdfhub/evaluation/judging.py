"""A trained shape space is meshed and judged, training and held-out shapes apart."""

import logging
import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, cast

import numpy as np
import torch
from pydantic import ConfigDict, Field, NonNegativeInt, PositiveInt, SkipValidation
from pydantic.dataclasses import dataclass
from torch import Tensor
from tqdm import tqdm

from sdfhub.data.store.store import shape_seed
from sdfhub.data.store.stored_shape import StoredShape
from sdfhub.data.workers import Crashed, map_in_processes
from sdfhub.errors import SdfhubError
from sdfhub.evaluation.scoresheet import Judged, write_scores
from sdfhub.geometry.mesh_file import write_mesh
from sdfhub.geometry.metrics import DistanceMetrics, judge
from sdfhub.geometry.render import render
from sdfhub.latent.fitting import Fit
from sdfhub.model.decoder import Decoder
from sdfhub.model.fast.computing import distances
from sdfhub.scans.observed_scan import observations_of
from sdfhub.shapes import Mesh, NormalizedMesh
from sdfhub.space import reconstruct

log = logging.getLogger(__name__)

WORTH_A_PROCESS = 4  # shapes to judge: a worker takes as long to start as to judge one or two
NOISE = 64  # faces, in squared resolutions, above which a field is noise: ten times those of the unit sphere
Role = tuple[str, StoredShape, Tensor]  # role, shape and code [L]


@dataclass(frozen=True, config=ConfigDict(arbitrary_types_allowed=True))
class Evaluation:
    """How a shape space is judged."""

    resolution: Annotated[int, Field(ge=2)]  # points along an axis of the marching-cubes grid
    points: PositiveInt  # surface points a side for Chamfer distance and F-score
    train: NonNegativeInt | None  # training shapes to judge, from the front of the code table; None: all
    held_out: NonNegativeInt | None  # held-out shapes to judge; None: all
    fit: SkipValidation[Fit]  # how codes of held-out shapes are found
    fit_together: PositiveInt  # held-out shapes fitted side by side
    pictures: NonNegativeInt  # shapes of each role on the contact sheet
    workers: NonNegativeInt | None = None  # processes that judge; None: one per core
    seed: NonNegativeInt = 0  # of every draw


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
    """Judges training shapes, by rows of the codes [S, L], and held-out ones; writes and gives the scores.

    Shapes without a mesh (DeepSDF's npz files) are judged by signed distances alone. Fits are clamped by
    `delta`; `training` is for `metrics.json`.
    """
    decoder.eval()
    known = list(train.items())[: evaluation.train]
    roles: list[Role] = [("train", shape, codes[row]) for row, shape in known]
    if unseen := list(held_out)[: evaluation.held_out]:
        fitted = fit_held_out(decoder, codes, delta, unseen, evaluation)
        roles += [("held_out", shape, code) for shape, code in zip(unseen, fitted, strict=True)]
    if all(shape.mesh is not None for _, shape, _ in roles):
        judged = judge_all(decoder, roles, evaluation, out)
    else:
        judged = [Judged(role, s, distance_metrics(decoder, code, s, delta)) for role, s, code in roles]
    return write_scores(judged, evaluation, training, out)


def fit_held_out(
    decoder: Decoder, codes: Tensor, delta: float, shapes: Sequence[StoredShape], evaluation: Evaluation
) -> Tensor:
    """Codes [S, L] of shapes from their signed samples."""
    fitted = []
    for start in range(0, len(shapes), evaluation.fit_together):
        group = shapes[start : start + evaluation.fit_together]
        seeds = [shape_seed(shape) ^ evaluation.seed for shape in group]
        observations = observations_of(group, evaluation.fit.samples, seeds)
        fitted.append(evaluation.fit(decoder, codes, observations, delta).codes)
    return torch.cat(fitted)


def judge_all(decoder: Decoder, roles: Sequence[Role], evaluation: Evaluation, out: Path) -> list[Judged]:
    """Meshes, writes and draws shapes one by one, and keeps no mesh, while workers judge those before."""
    pictures: list[tuple[np.ndarray, np.ndarray | str] | None] = []
    of_role = Counter[str]()

    def pairs() -> Iterator[tuple[Mesh, NormalizedMesh]]:
        for role, shape, code in tqdm(roles, desc="judging", unit="shape", leave=False, disable=None):
            ((vertices, faces),) = reconstruct(decoder, code[None], evaluation.resolution)
            if len(faces) > NOISE * evaluation.resolution**2:
                log.warning("%s: its field is noise, %s faces: no surface", shape.id, f"{len(faces):,}")
                vertices, faces = vertices[:0], faces[:0]
            path, truth = out / "meshes" / role / f"{shape.id}.ply", cast(NormalizedMesh, shape.mesh)
            write_mesh(shape.frame.to_source(vertices), faces, path)
            of_role[role] += 1
            drawn = None
            if of_role[role] <= evaluation.pictures:
                own = render(vertices, faces, up=shape.up) if len(faces) else "no surface"
                drawn = render(truth.vertices, truth.faces, up=shape.up), own
            pictures.append(drawn)
            yield Mesh(vertices, faces), truth

    workers = (os.cpu_count() or 1) if evaluation.workers is None else evaluation.workers
    workers = min(workers, len(roles) // WORTH_A_PROCESS)
    judge_one = lambda pair: judge(pair[0], pair[1], evaluation.points, evaluation.seed)  # noqa: E731
    metrics = [row for _, row in sorted(map_in_processes(judge_one, pairs(), workers))]
    if any(isinstance(row, Crashed) for row in metrics):
        raise SdfhubError("a process that judges died twice: out of memory? try evaluate.workers=0")
    columns = zip(roles, metrics, pictures, strict=True)
    return [Judged(role, shape, row, drawn) for (role, shape, _), row, drawn in columns]


@torch.inference_mode()
def distance_metrics(decoder: Decoder, code: Tensor, shape: StoredShape, delta: float) -> DistanceMetrics:
    """How far the field is from a shape's own samples, up to 100,000 a side."""
    rng = np.random.default_rng(0)
    counts = {name: shape.rows(name) for name in ("outside", "inside")}
    sides = [shape.read(name, int(rng.integers(n or 1)), min(n, 100_000)) for name, n in counts.items()]
    rows = torch.from_numpy(np.concatenate(sides)).to(code.device)
    field = distances(decoder, rows[None, :, :3], code[None])[0]
    error = (field - rows[:, 3]).abs()[rows[:, 3].abs() < delta].mean()
    return DistanceMetrics(float(error), float(((field < 0) == (rows[:, 3] < 0)).float().mean()))
