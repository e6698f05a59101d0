"""Cells become rows: one row a method, its seeds together; one group for what may be compared."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import pandas as pd
from scipy import stats

from sdfhub.report.results import ROLES, TABLE_UNIT, Cell
from sdfhub.settings import OF_THE_SEED, deciding

# encodings, as the paper writes them or would
PREFIXES = {"none": "", "fourier": "FFT/", "gaussian": "GAUSS/", "hash": "HASH/"}
# groups and settings that decide which shapes are judged, and how: rows that differ in one are not compared
JUDGING_GROUPS = ("sweeps", "data", "category", "scale", "fit", "evaluate")
JUDGING_SETTINGS = ("data.", "evaluate.", "scale.small_table")  # but for `data.loader.`

MEASURES = ["cd", "floor", "excess", "normal_consistency", "no_surface", "sdf_error", "sign_accuracy"]
NAMES = ["method", "normals", "detail", "label"]
PLACES = [*JUDGING_GROUPS, "settings", *NAMES, "cell", "seed", "role", "shape"]
SCORED = ["cd", "floor", "cd_penalty", "failed", "normal_consistency", "sdf_error", "sign_accuracy"]
COSTS = ["trained_on", "parameters", "epochs", "steps", "samples", "seconds"]

NONE = "–"  # what tables show where there is nothing


@dataclass
class Row:
    """A method in a group of comparable cells, one a seed."""

    method: str  # as the paper writes it: `FFT/SIREN`
    normals: str  # `on` or `off`
    detail: str  # what else tells the row from others of its method; mostly empty
    cells: list[Cell]

    def __post_init__(self) -> None:
        words = {"on": " + normals", "off": ", no normals" if self.method != "DeepSDF" else ""}
        ending = words.get(self.normals, f", normals {self.normals}")  # labels name rows: no two are equal
        self.label = self.method + ending + (f" ({self.detail})" if self.detail else "")
        self.done = [cell for cell in self.cells if cell.state == "done"]
        self.first = self.done[0] if self.done else None
        # what stands for a row without finished cells, and what search its settings come from
        self.state = "failed" if any(cell.state == "failed" for cell in self.cells) else "missing"
        self.names = {name: getattr(self, name) for name in NAMES}
        self.searched = str(self.done[0].scores.config.get("searched") or "no")[:200] if self.done else NONE


@dataclass
class Group:
    """Rows that may be compared: the same sweep, shapes, scale and way of judging."""

    judging: dict[str, str]  # options of JUDGING_GROUPS, values of JUDGING_SETTINGS on the command line
    rows: list[Row]  # in the order of the commands, each with normals first

    def __post_init__(self) -> None:
        done = [cell for row in self.rows for cell in row.done]
        self.first = done[0] if done else None
        self.settings = [f"{key}={value}" for key, value in self.judging.items() if key not in JUDGING_GROUPS]
        groups = {name: self.judging.get(name, "") for name in JUDGING_GROUPS}
        self.place = groups | {"settings": ";".join(self.settings)}  # columns of a CSV file
        counts = sorted({cell.scores.trained_on for cell in done})
        ends = " to ".join(map(str, dict.fromkeys(counts[:1] + counts[-1:]))) or "nothing yet"
        parts = [f"{k}={v}" for k, v in self.judging.items() if k not in ("sweeps", "category")]
        # words such as `chairs`, `data=open`, `scale=cpu`, `evaluate=paper`, `trained on 20`
        self.title = [self.judging.get("category", "all"), *parts, f"trained on {ends}"]

    @cached_property
    def shapes(self) -> pd.DataFrame:
        """MEASURES of each judged shape, distances times 10^3; `cd` is that of a point where nothing is."""
        records = [
            self.place | row.names | {"cell": cell.plan.folder, "seed": cell.plan.seed}
            | {"role": role, "shape": shape.id} | dict(shape)
            for row in self.rows
            for cell in row.done
            for role, shapes in cell.scores.shapes.items()
            for shape in shapes
        ]  # fmt: skip
        frame = pd.DataFrame(records, columns=[*PLACES, *SCORED]).astype(dict.fromkeys(SCORED, float))
        has_surface = (frame["failed"] == 0) & frame["cd"].notna()
        frame["cd"] = frame["cd"].where(has_surface, frame["cd_penalty"])
        frame["excess"] = frame["cd"] - frame["floor"]
        frame[["cd", "floor", "excess", "sdf_error"]] *= TABLE_UNIT
        return frame.rename(columns={"failed": "no_surface"})[[*PLACES, *MEASURES]]

    @cached_property
    def statistics(self) -> pd.DataFrame:
        """Means over seeds, by label and role: `cd_mean`, `excess_median`, ..., `no_surface`, `shapes`."""
        cells = self.shapes.groupby(["label", "role", "cell"], sort=False)
        frame = cells[[name for name in MEASURES if name != "no_surface"]].agg(["mean", "median"])
        frame.columns = pd.Index(["_".join(names) for names in frame.columns])
        frame["no_surface"], frame["shapes"] = cells["no_surface"].sum(), cells.size()
        return over_seeds(frame, ["label", "role"])

    @cached_property
    def costs(self) -> pd.DataFrame:
        """COSTS by label, over seeds as in `statistics`."""
        records = [{"label": row.label} | cell.scores.costs() for row in self.rows for cell in row.done]
        frame = pd.DataFrame(records, columns=["label", *COSTS]).astype(dict.fromkeys(COSTS, float))
        return over_seeds(frame, ["label"])


def over_seeds(cells: pd.DataFrame, by: list[str]) -> pd.DataFrame:
    """Each column's mean over lines of equal `by`; `_ci95`: half the 95% interval; `_seeds`: count."""
    seeds = cells.groupby(by, sort=False)
    count = seeds.count()
    half_width = seeds.sem() * stats.t.ppf(0.975, count - 1)  # not a number for one seed
    return pd.concat([seeds.mean(), half_width.add_suffix("_ci95"), count.add_suffix("_seeds")], axis=1)


def settings_of(cell: Cell) -> dict[str, str]:
    """Settings of a finished cell by dotted key that can change its result, but for the seed's."""
    settings = deciding(cell.scores.config).items()
    return {str(k): str(v)[:200] for k, v in settings if k not in (*OF_THE_SEED, "searched")}


def differing(settings: list[dict[str, Any]]) -> dict[str, tuple[str, ...]]:
    """The keys in which dicts differ, and their values; keys of one last name and equal values are joined."""
    joined: dict[tuple, list[str]] = {}
    for key in dict.fromkeys(key for row in settings for key in row):
        values = tuple(str(row.get(key, NONE)) for row in settings)
        if len(set(values)) > 1:
            joined.setdefault((key.rpartition(".")[2], values), []).append(key)
    return {", ".join(keys): values for (_, values), keys in joined.items()}


def group_cells(cells: list[Cell]) -> list[Group]:
    """The cells of a sweep as groups of rows."""
    members = _apart(cells, lambda cell: tuple(_judging(cell).items()))
    return [Group(dict(judging), _rows(cells)) for judging, cells in members.items()]


def _apart(cells: list[Cell], key: Callable[[Cell], Any]) -> dict[Any, list[Cell]]:
    parts: dict[Any, list[Cell]] = {}
    for cell in cells:
        parts.setdefault(key(cell), []).append(cell)
    return parts


def _judging(cell: Cell) -> dict[str, str]:
    choices, settings = cell.plan.choices, cell.plan.settings
    keys = sorted(k for k in settings if k.startswith(JUDGING_SETTINGS) and not k.startswith("data.loader."))
    return {k: choices[k] for k in JUDGING_GROUPS if k in choices} | {k: settings[k] for k in keys}


def _rows(cells: list[Cell]) -> list[Row]:
    shared = set.intersection(*(set(cell.plan.settings.items()) for cell in cells))
    rows: list[Row] = []
    for members in _apart(cells, lambda cell: cell.plan.identity[:2]).values():
        plan = members[0].plan
        namesakes = [cell.plan.choices for cell in cells if _name(cell.plan.choices) == _name(plan.choices)]
        own = dict(pair for pair in plan.settings.items() if pair not in shared)
        own |= {key: plan.choices.get(key, NONE) for key in differing(namesakes)}
        # seeds of one command line stand apart where defaults changed; unfinished ones with the last
        done = [cell for cell in members if cell.state == "done"]
        parts = list(_apart(done, lambda cell: str(settings_of(cell))).values()) or [[]]
        parts[-1] += [cell for cell in members if cell.state != "done"]
        changed = differing([settings_of(part[0]) for part in parts])
        for number, part in enumerate(parts):
            words = own | {key.partition(",")[0]: values[number] for key, values in changed.items()}
            detail = ", ".join(f"{key}={value}" for key, value in words.items())
            rows.append(Row(*_name(plan.choices), detail, part))
    methods = list(dict.fromkeys(row.method for row in rows))
    return sorted(rows, key=lambda row: (methods.index(row.method), row.normals != "on"))


def _name(choices: dict[str, str]) -> tuple[str, str]:
    """Method and normals."""
    encoding, activation = choices.get("encoding", "none"), choices.get("activation", "?")
    is_deepsdf = choices.get("decoder") == "deepsdf" and activation == "relu"
    method = "DeepSDF" if is_deepsdf else activation.upper()
    return PREFIXES.get(encoding, f"{encoding.upper()}/") + method, choices.get("normals", "?")


def table_csv(groups: list[Group]) -> str:
    """Every row of every group as numbers: a line a role, `Group.statistics` and `Group.costs` in it."""
    frames = [pd.DataFrame({"label": []})]
    for group in groups:
        rows = [
            group.place | row.names | {"cells": len(row.cells), "searched": row.searched, "role": role}
            for row in group.rows
            for role in ROLES
        ]
        numbers = pd.DataFrame(rows).join(group.statistics, on=["label", "role"])
        frames.append(numbers.join(group.costs, on="label"))
    return pd.concat(frames[1:] or frames).to_csv(index=False, float_format="%.9g")


def shapes_csv(groups: list[Group]) -> str:
    """Every judged shape of every cell as numbers, distances times 10^3; no `cd` without a surface."""
    frame = pd.concat([group.shapes for group in groups or [Group({}, [])]])
    frame["cd"] = frame["cd"].where(frame["no_surface"] != 1)
    return frame.to_csv(index=False, float_format="%.9g")
