"""A sweep's folder as plain data: the cells that `sweep.json` lists, and what each has left behind, checked.

A cell is one training. Nothing in its files is run, and no link is followed out of its folder.
"""

import json
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import yaml
from pydantic import BaseModel, Field, Json, StringConstraints, TypeAdapter, ValidationError

from sdfhub.errors import SdfhubError
from sdfhub.settings import flat
from sdfhub.whole_file import locked, write_whole

PLAN, FAILURE = "sweep.json", "failed.json"
ROLES = ("train", "held_out")
TABLE_UNIT = 1e3  # Chamfer distances and errors of distances are shown times 10^3

Text = Annotated[str, StringConstraints(max_length=2000)]
FolderName = Annotated[str, StringConstraints(pattern=r"^[^./\\][^/\\]*$", max_length=255)]
Number = Annotated[float, Field(ge=-1e12, le=1e12, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=0, le=10**12)]


class PlannedCell(BaseModel, frozen=True, extra="forbid", strict=True):
    """One cell as its command line described it."""

    folder: FolderName  # below the sweep's
    choices: dict[Text, Text]  # option by config group, `sweeps` among them
    settings: dict[Text, Text]  # values set beside the groups and the seed, by dotted key
    seed: int

    @property
    def identity(self) -> tuple[tuple, tuple, int]:
        """Choices, settings and seed: two cells that agree in them are one, under old and new defaults."""
        return tuple(sorted(self.choices.items())), tuple(sorted(self.settings.items())), self.seed


class Plan(BaseModel, extra="forbid"):
    """The content of `sweep.json`: the cells in the order of their commands, and these."""

    version: Literal[1] = 1
    cells: list[PlannedCell] = []
    commands: list[Text] = []


def read_plan(sweep: Path) -> Plan:
    """What a sweep's folder consists of; refuses one that is none, or whose `sweep.json` is broken."""
    return read_json(Plan, sweep / PLAN, "the folder of a multirun")


def read_json(kind: type[BaseModel], path: Path, owner: str) -> Any:
    """What a JSON file says, checked; a folder that has no such file is refused as not `owner`."""
    try:
        return _checked(Json[kind], path.read_bytes(), str(path))  # type: ignore[misc, valid-type]
    except OSError as error:
        raise SdfhubError(f"{path.parent}: not {owner}: it has no {path.name}") from error


def enter_cells(sweep: Path, cells: Iterable[PlannedCell], command: str | None = None) -> None:
    """Adds cells to `sweep.json`, and the command that asked for them; of one folder the shortest stays."""
    sweep.mkdir(parents=True, exist_ok=True)
    with locked(sweep / ".lock"):
        old = read_plan(sweep) if (sweep / PLAN).exists() else Plan()
        by_folder: dict[str, PlannedCell] = {}
        for cell in {cell.identity: cell for cell in (*old.cells, *cells)}.values():
            rival = by_folder.setdefault(cell.folder, cell)
            by_folder[cell.folder] = min(rival, cell, key=lambda planned: len(planned.settings))
        commands = dict.fromkeys([*old.commands, *([command[:2000]] if command else [])])
        plan = Plan(cells=list(by_folder.values()), commands=list(commands))
        write_whole(sweep / PLAN, plan.model_dump_json(indent=1))


class ShapeScore(BaseModel, frozen=True):
    """One judged shape."""

    id: Text
    cd: Number | None
    floor: Number
    cd_penalty: Number  # the Chamfer distance of a single point
    failed: bool  # the field has no surface
    normal_consistency: Number | None = None

    @property
    def counted_cd(self) -> float:
        """The Chamfer distance; that of a single point where the field has no surface."""
        return self.cd_penalty if self.failed or self.cd is None else self.cd

    @property
    def excess(self) -> float:
        """What the Chamfer distance has above its noise floor."""
        return self.counted_cd - self.floor


class DistanceScore(BaseModel, frozen=True):
    """One shape of a source without meshes: mean |f - d| near its surface, share of signs that are right."""

    id: Text
    sdf_error: Number
    sign_accuracy: Number


class Training(BaseModel, frozen=True):
    """The cost of a training, and versions and hardware by name."""

    seconds: Number
    steps: Count
    parameters: Count
    made_with: dict[Text, Text] = {}


class Scores(NamedTuple):
    """The scores of a finished cell."""

    shapes: dict[str, list[ShapeScore] | list[DistanceScore]]  # by role
    training: Training
    trained_on: int  # shapes, without augmented copies
    config: dict[str, Any]  # of config.yaml

    def costs(self) -> dict[str, float]:
        """Cost by name: `epochs` that were asked for, signed `samples` drawn in all, ..."""
        costs = self.training.model_dump(exclude={"made_with"}) | {"trained_on": self.trained_on}
        settings = flat(self.config)
        with suppress(KeyError, TypeError, ValueError, OverflowError):  # a loader of the user's own
            costs["epochs"] = int(settings["trainer.max_epochs"])
            rows = self.trained_on * (1 + int(settings.get("data.loader.augmentation.copies") or 0))
            shapes = min(rows, int(settings["data.loader.shapes_per_step"]))
            costs["samples"] = shapes * int(settings["data.loader.samples_per_shape"]) * self.training.steps
        return costs


class Cell(NamedTuple):
    """A cell of a sweep as it stands; `failed` also where its files are broken."""

    plan: PlannedCell
    folder: Path
    state: Literal["done", "failed", "missing"]
    reason: str = ""  # why it is not done
    scores: Scores = Scores({}, Training(seconds=0, steps=0, parameters=0), 0, {})


def read_sweep(sweep: Path) -> list[Cell]:
    """All planned cells of a sweep's folder; a broken one carries its reason and ends nothing."""
    return [_read_cell(plan, sweep / plan.folder) for plan in read_plan(sweep).cells]


def _read_cell(plan: PlannedCell, folder: Path) -> Cell:
    try:
        if not folder.resolve().is_relative_to(folder.parent.resolve()):
            return Cell(plan, folder, "failed", "its folder is a link out of the sweep")
        if (folder / FAILURE).exists():
            return Cell(plan, folder, "failed", str(_read(folder, FAILURE).get("reason"))[:500])
        if not (folder / "metrics.json").exists():
            begun = (folder / "config.yaml").exists()
            return Cell(plan, folder, "missing", "is not finished" if begun else "has not been run")
        return Cell(plan, folder, "done", scores=read_scores(folder))
    except (SdfhubError, OSError) as error:
        return Cell(plan, folder, "failed", str(error))


def read_scores(folder: Path) -> Scores:
    """The scores of a finished run's folder; refuses files that are not what training writes."""
    metrics, shapes = _read(folder, "metrics.json"), {}
    for role in filter(metrics.get, ROLES):
        rows = _checked(dict, metrics[role], f"metrics.json: {role}").get("shapes")
        kind: Any = DistanceScore if "sdf_error" in str(rows)[:1000] else ShapeScore
        shapes[role] = _checked(list[kind], rows, f"metrics.json: {role}.shapes")
    training = _checked(Training, metrics.get("training"), "metrics.json: training")
    trained_on = _checked(list[Text], _read(folder, "split.json").get("train"), "split.json: train")
    return Scores(shapes, training, len(trained_on), _read(folder, "config.yaml"))


def _read(folder: Path, name: str) -> dict[str, Any]:
    if not (folder / name).resolve().is_relative_to(folder.resolve()):
        raise SdfhubError(f"{name}: is a link out of its folder")
    try:
        text = (folder / name).read_text(encoding="utf-8")
        content = json.loads(text) if name.endswith(".json") else yaml.safe_load(text)
    except (OSError, ValueError, yaml.YAMLError, RecursionError) as error:
        raise SdfhubError(f"{name}: cannot be read ({type(error).__name__})") from error
    return _checked(dict, content, name)


def _checked(kind: Any, content: Any, name: str) -> Any:
    try:
        return TypeAdapter(kind).validate_python(content)
    except ValidationError as error:
        fault = error.errors()[0]
        raise SdfhubError(f"{'.'.join(map(str, (name, *fault['loc'])))}: {fault['msg'].lower()}") from error
