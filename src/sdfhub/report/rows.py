"""Cells become rows: one row a method, its seeds together; one group for what may be compared."""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import pandas as pd
from scipy import stats

from sdfhub.report.results import ROLES, Cell
from sdfhub.settings import OF_THE_SEED, deciding

PREFIXES = {"none": "", "fourier": "FFT/", "gaussian": "GAUSS/", "hash": "HASH/"}
"""The paper's names of encodings, and ours for those that it does not name."""

JUDGING_GROUPS = ("sweeps", "data", "category", "scale", "fit", "evaluate")
"""Config groups under which numbers may be compared: rows that differ in one stand in different tables."""

JUDGING_SETTINGS = ("data.", "evaluate.", "scale.small_table")
"""Settings of the command line that decide which shapes are judged, and how; `data.loader.` does not."""

MEASURES = ("cd", "floor", "excess", "normal_consistency", "no_surface", "sdf_error", "sign_accuracy")
COSTS = ("trained_on", "parameters", "epochs", "steps", "samples", "seconds")

NONE = "–"
"""What tables show where there is nothing."""


@dataclass(frozen=True)
class Row:
    """A method in a group of comparable cells.

    Args:
        method: as the paper writes it: `FFT/SIREN`.
        normals: `on` or `off`.
        detail: what else tells the row from others of its method; mostly empty.
        cells: one a seed.
    """

    method: str
    normals: str
    detail: str
    cells: list[Cell]

    @property
    def label(self) -> str:
        """Method, normals unless it is DeepSDF without them, and detail, in one line."""
        words = {"on": " + normals", "off": ", no normals" if self.method != "DeepSDF" else ""}
        return self.method + words.get(self.normals, "") + (f" ({self.detail})" if self.detail else "")

    @property
    def done(self) -> list[Cell]:
        """The finished cells."""
        return [cell for cell in self.cells if cell.scores]

    @property
    def searched(self) -> str:
        """What search the settings come from, as the experiment's config says: `no` where it says nothing."""
        return str(self.done[0].scores.config.get("searched") or "no")[:200] if self.done else NONE


@dataclass(frozen=True)
class Group:
    """Rows that may be compared: the same sweep, shapes, scale and way of judging.

    Args:
        choices: options of JUDGING_GROUPS.
        judging: values of JUDGING_SETTINGS on the command line.
        shared: other values on the command line that all rows have.
        varying: names of choices in which the groups of the sweep differ.
        rows: in the order of the commands.
    """

    choices: dict[str, str]
    judging: dict[str, str]
    shared: dict[str, str]
    varying: set[str]
    rows: list[Row]

    @property
    def title(self) -> str:
        """`chairs, data=open, scale=cpu, trained on 20`."""
        return ", ".join(self.title_parts)

    @property
    def title_parts(self) -> list[str]:
        """The words of the title: the category, or the name of the user's folder, first."""
        subject = self.choices.get("category", "all")
        if self.choices.get("data") == "folder" and "data.source.root" in self.judging:
            subject = Path(self.judging["data.source.root"]).name
        named = {"data", "scale", *self.varying} - {"category"}
        told = {name: option for name, option in self.choices.items() if name in named} | self.judging
        shapes = [cell.scores.trained_on for row in self.rows for cell in row.done]
        ends = " to ".join(dict.fromkeys(map(str, (min(shapes), max(shapes))))) if shapes else ""
        return [subject, *(f"{k}={v}" for k, v in told.items()), *([f"trained on {ends}"] if ends else [])]

    @cached_property
    def shapes(self) -> pd.DataFrame:
        """A line for each judged shape of each finished cell: MEASURES, distances times 10^3.

        The `cd` of a shape without a surface is that of a single point.
        """
        records = [
            vars(row) | {"label": row.label, "cell": cell.plan.folder, "seed": cell.plan.seed}
            | {"role": role, "shape": shape.id} | shape.measures()
            for row in self.rows
            for cell in row.done
            for role, shapes in cell.scores.shapes.items()
            for shape in shapes
        ]  # fmt: skip
        places = ["method", "normals", "detail", "label", "cell", "seed", "role", "shape"]
        return pd.DataFrame(records, columns=[*places, *MEASURES]).astype(dict.fromkeys(MEASURES, float))

    @cached_property
    def statistics(self) -> pd.DataFrame:
        """Means over seeds, by label and role: `cd_mean`, `excess_median`, ..., `no_surface`, `shapes`.

        Beside each column `_ci95`, the half width of its 95% interval (Student's t; none for one seed), and
        `_seeds`, how many seeds it is the mean of.
        """
        cells = self.shapes.groupby(["label", "role", "cell"], sort=False)
        frame = cells[[name for name in MEASURES if name != "no_surface"]].agg(["mean", "median"])
        frame.columns = ["_".join(names) for names in frame.columns]
        frame["no_surface"], frame["shapes"] = cells["no_surface"].sum(), cells.size()
        return over_seeds(frame, ["label", "role"])

    @cached_property
    def costs(self) -> pd.DataFrame:
        """COSTS by label, over seeds as in `statistics`."""
        records = [{"label": row.label} | cell.scores.costs() for row in self.rows for cell in row.done]
        frame = pd.DataFrame(records, columns=["label", *COSTS]).astype(dict.fromkeys(COSTS, float))
        return over_seeds(frame, ["label"])


def over_seeds(cells: pd.DataFrame, by: list[str]) -> pd.DataFrame:
    """The mean of each column over the lines of equal `by`, the half width of its 95% interval, its count."""
    seeds = cells.groupby(by, sort=False)
    count = seeds.count()
    half_width = seeds.sem() * stats.t.ppf(0.975, count - 1)  # not a number for one seed
    return pd.concat([seeds.mean(), half_width.add_suffix("_ci95"), count.add_suffix("_seeds")], axis=1)


def settings_of(cell: Cell) -> dict[str, str]:
    """Settings of a finished cell by dotted key that can change its result, but for the seed's."""
    settings = deciding(cell.scores.config).items()
    return {str(k): str(v)[:200] for k, v in settings if k not in (*OF_THE_SEED, "searched")}


def differing(settings: list[dict[str, Any]]) -> dict[str, tuple[str, ...]]:
    """The keys in which dicts differ, and their values in each.

    Keys of one last name and equal values, such as interpolated ones, are joined by a comma.
    """
    joined: dict[tuple, list[str]] = {}
    for key in dict.fromkeys(key for one in settings for key in one):
        values = tuple(str(one.get(key, NONE)) for one in settings)
        if len(set(values)) > 1:
            joined.setdefault((key.rpartition(".")[2], values), []).append(key)
    return {", ".join(keys): values for (_, values), keys in joined.items()}


def group_cells(cells: list[Cell]) -> list[Group]:
    """The cells of a sweep as groups of rows."""
    members: dict[tuple, list[Cell]] = {}
    for cell in cells:
        members.setdefault(tuple(map(str, (_choices(cell), _judging(cell)))), []).append(cell)
    varying = set(differing([_choices(cells[0]) for cells in members.values()]))
    return [_group(cells, varying) for cells in members.values()]


def _choices(cell: Cell) -> dict[str, str]:
    return {name: cell.plan.choices[name] for name in JUDGING_GROUPS if name in cell.plan.choices}


def _judging(cell: Cell) -> dict[str, str]:
    settings = sorted(cell.plan.settings.items())
    return {k: v for k, v in settings if k.startswith(JUDGING_SETTINGS) and not k.startswith("data.loader.")}


def _group(cells: list[Cell], varying: set[str]) -> Group:
    shared = dict(sorted(set.intersection(*(set(cell.plan.settings.items()) for cell in cells))))
    commands: dict[tuple, list[Cell]] = {}
    for cell in cells:
        commands.setdefault(cell.plan.identity[:2], []).append(cell)
    rows: list[Row] = []
    for members in commands.values():
        plan = members[0].plan
        name = _method(plan.choices), plan.choices.get("normals", "?")
        namesakes = [cell.plan.choices for cell in cells if _method(cell.plan.choices) == name[0]]
        namesakes = [choices for choices in namesakes if choices.get("normals", "?") == name[1]]
        own = {k: v for k, v in plan.settings.items() if k not in shared}
        own |= {k: plan.choices.get(k, NONE) for k in differing(namesakes)}
        parts = _by_settings(members)
        changed = differing([settings_of(part[0]) for part in parts]) if len(parts) > 1 else {}
        for number, part in enumerate(parts):
            words = own | {key.partition(",")[0]: values[number] for key, values in changed.items()}
            row = Row(*name, ", ".join(f"{key}={_short(value)}" for key, value in words.items()), part)
            twins = sum(row.label == other.label for other in rows)
            rows.append(replace(row, detail=f"{row.detail}, {twins + 1}") if twins else row)
    judging = _judging(cells[0])
    return Group(
        _choices(cells[0]), judging, {k: shared[k] for k in shared if k not in judging}, varying, rows
    )


def _by_settings(cells: list[Cell]) -> list[list[Cell]]:
    """Seeds of one command line, apart where defaults changed between them; unfinished ones with the last."""
    parts: dict[tuple, list[Cell]] = {}
    for cell in cells:
        if cell.scores:
            parts.setdefault(tuple(settings_of(cell).items()), []).append(cell)
    found = list(parts.values()) or [[]]
    found[-1].extend(cell for cell in cells if not cell.scores)
    return found


def _method(choices: dict[str, str]) -> str:
    encoding, activation = choices.get("encoding", "none"), choices.get("activation", "?")
    is_deepsdf = choices.get("decoder") == "deepsdf" and activation == "relu"
    return PREFIXES.get(encoding, f"{encoding.upper()}/") + ("DeepSDF" if is_deepsdf else activation.upper())


def _short(value: str) -> str:
    """A number of more than six characters to five digits: a search draws them with sixteen."""
    try:
        return f"{float(value):.5g}" if len(value) > 6 else value
    except ValueError:
        return value


def table_csv(groups: list[Group]) -> str:
    """Every row of every group as numbers: a line a role, `Group.statistics` and `Group.costs` in it."""
    frames = []
    for group in groups:
        for row in group.rows:
            known = {"method": row.method, "normals": row.normals, "detail": row.detail, "label": row.label}
            known |= {"searched": row.searched, "cells": len(row.cells)}
            line = pd.DataFrame([_place(group) | known | {"role": role} for role in ROLES])
            frames.append(line.join(group.statistics, on=["label", "role"]).join(group.costs, on="label"))
    return pd.concat(frames).to_csv(index=False, float_format="%.7g") if frames else ""


def shapes_csv(groups: list[Group]) -> str:
    """Every judged shape of every cell as numbers: a line a seed, role and shape; distances times 10^3.

    No `cd` where there is no surface, whose excess counts the CD of a single point.
    """
    frames = [pd.DataFrame([_place(group)]).merge(group.shapes, how="cross") for group in groups]
    frame = pd.concat(frames) if frames else pd.DataFrame({"cd": [], "no_surface": []})
    frame["cd"] = frame["cd"].where(frame["no_surface"] != 1)
    return frame.to_csv(index=False, float_format="%.7g")


def _place(group: Group) -> dict[str, str]:
    """What tells a group from others, by column of a CSV file."""
    settings = ";".join(f"{key}={value}" for key, value in (group.judging | group.shared).items())
    return {name: group.choices.get(name, "") for name in JUDGING_GROUPS} | {"settings": settings}
