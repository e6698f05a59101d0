"""What a cell left behind, read as plain data and checked: its scores, its cost, or why there are none."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Generic, Literal, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, Field, StringConstraints, ValidationError

from sdfhub.errors import SdfhubError
from sdfhub.locks import is_locked
from sdfhub.report.plan import FAILURE, PlannedCell, read_plan

NOISE = 1e-6
"""Excess that 30,000 points a side cannot tell from none."""

ROLES = ("known", "held_out")


class _Read(BaseModel):
    """Numbers must be finite; what a file says beside the fields is not looked at."""

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)


Name = Annotated[str, StringConstraints(max_length=200)]

Score = TypeVar("Score")


class ShapeScore(_Read):
    """One judged shape: Chamfer distance, its noise floor, what a failure counts as, agreement of normals."""

    id: str = Field(max_length=300)
    cd: float | None
    floor: float
    cd_penalty: float
    failed: bool
    normal_consistency: float | None = None

    @property
    def counted_cd(self) -> float:
        """The Chamfer distance; that of a single point where the field has no surface."""
        return self.cd_penalty if self.failed or self.cd is None else self.cd

    @property
    def excess(self) -> float:
        """What the Chamfer distance has above its noise floor."""
        return self.counted_cd - self.floor


class DistanceScore(_Read):
    """One shape of a source without meshes: mean |f - d| near its surface, share of signs that are right."""

    id: str = Field(max_length=300)
    sdf_error: float
    sign_accuracy: float


class Training(_Read):
    """The cost of a training, and versions and hardware by name, which old runs do not tell."""

    seconds: float
    steps: int
    parameters: int
    made_with: dict[Name, Name] = {}


class _Role(_Read, Generic[Score]):
    shapes: list[Score]


class _Metrics(_Read, Generic[Score]):
    training: Training | None
    known: _Role[Score] | None = None
    held_out: _Role[Score] | None = None


class _Augmentation(_Read):
    copies: int = 0


class _Loader(_Read):
    shapes_per_step: int
    samples_per_shape: int
    augmentation: _Augmentation = _Augmentation()


class _Data(_Read):
    loader: _Loader


class _Trainer(_Read):
    max_epochs: int | None


class _Config(_Read):
    data: _Data
    trainer: _Trainer


class _Split(_Read):
    train: list[str]


@dataclass(frozen=True)
class Scores:
    """The scores and the cost of a finished cell.

    Args:
        shapes: shapes judged by their surfaces, by role.
        distances: shapes of a source without meshes, by role.
        training: its cost.
        epochs: passes that the trainer was asked for.
        samples: signed samples drawn in all.
        trained_on: training shapes, without augmented copies.
        config: the content of `config.yaml`.
    """

    shapes: dict[str, list[ShapeScore]]
    distances: dict[str, list[DistanceScore]]
    training: Training
    epochs: int | None
    samples: int
    trained_on: int
    config: dict


@dataclass(frozen=True)
class Cell:
    """A cell of a sweep as it stands.

    Args:
        plan: what it is.
        folder: where it lies.
        state: `failed` also where its files are broken.
        reason: why there are no scores; empty where there are.
        scores: None unless `state` is done.
    """

    plan: PlannedCell
    folder: Path
    state: Literal["done", "failed", "missing"]
    reason: str
    scores: Scores | None


def read_sweep(sweep: Path) -> list[Cell]:
    """All planned cells of a sweep's folder; a broken one is told in a line, not raised.

    Raises:
        SdfhubError: not a sweep's folder.
    """
    return [_read_cell(plan, sweep / plan.folder) for plan in read_plan(sweep).cells]


def _read_cell(plan: PlannedCell, folder: Path) -> Cell:
    if is_locked(folder / ".lock"):
        return Cell(plan, folder, "missing", "is being trained", None)
    if (folder / FAILURE).exists():
        return Cell(plan, folder, "failed", _failure(folder / FAILURE), None)
    if not (folder / "metrics.json").exists():
        begun = (folder / "config.yaml").exists()
        return Cell(plan, folder, "missing", "was interrupted" if begun else "has not been run", None)
    try:
        return Cell(plan, folder, "done", "", read_scores(folder))
    except SdfhubError as error:
        return Cell(plan, folder, "failed", str(error), None)


def read_scores(folder: Path) -> Scores:
    """The scores of a finished run's folder.

    Raises:
        SdfhubError: a file is missing, broken or not what training writes.
    """
    content = _loaded(folder / "metrics.json")
    by_distance = any("sdf_error" in json.dumps(content.get(role, {}))[:2000] for role in ROLES)
    kind = DistanceScore if by_distance else ShapeScore
    metrics = _checked(_Metrics[kind], content, "metrics.json")
    raw = _loaded(folder / "config.yaml")
    config = _checked(_Config, raw, "config.yaml")
    shapes = len(_checked(_Split, _loaded(folder / "split.json"), "split.json").train)
    if metrics.training is None:
        raise SdfhubError("metrics.json: says nothing about a training")
    loader = config.data.loader
    rows = shapes * (1 + loader.augmentation.copies)
    drawn = metrics.training.steps * min(loader.shapes_per_step, rows) * loader.samples_per_shape
    roles = {role: getattr(metrics, role).shapes for role in ROLES if getattr(metrics, role)}
    found = ({}, roles) if by_distance else (roles, {})
    return Scores(*found, metrics.training, config.trainer.max_epochs, drawn, shapes, raw)


def _failure(path: Path) -> str:
    try:
        return str(_loaded(path)["reason"])[:500]
    except (SdfhubError, KeyError):
        return "for a reason that was not written down"


def _loaded(path: Path) -> dict:
    try:
        text = path.read_text(encoding="utf-8")
        content = json.loads(text) if path.suffix == ".json" else yaml.safe_load(text)
    except (OSError, ValueError, yaml.YAMLError, RecursionError) as error:
        raise SdfhubError(f"{path.name}: cannot be read ({type(error).__name__})") from error
    if not isinstance(content, dict):
        raise SdfhubError(f"{path.name}: not what training writes")
    return content


def _checked(model: type[BaseModel], content: dict, name: str):
    try:
        return model.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        raise SdfhubError(f"{name}: {'.'.join(map(str, first['loc']))}: {first['msg'].lower()}") from error
