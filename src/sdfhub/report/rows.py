"""Cells become rows: one row a method, its seeds together; one group a table's worth of settings."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import stats

from sdfhub.report.results import Cell
from sdfhub.settings import OF_THE_SEED, deciding

PREFIXES = {"none": "", "fourier": "FFT/", "gaussian": "GAUSS/", "hash": "HASH/"}
"""The paper's names of encodings, and ours for those that it does not name."""

ORDER = ("DeepSDF", "SIREN", "FFT/SIREN", "FFT/HOSC", "HASH/SIREN", "HASH/HOSC")
"""Rows of the paper's tables first, in its order."""

OF_THE_GROUP = ("sweeps", "data", "category", "scale", "fit", "evaluate")
"""Choices under which numbers may be compared: rows that differ in one stand in different tables."""

THOUSANDFOLD = ("cd_mean", "cd_median", "excess_mean", "excess_median")


@dataclass(frozen=True)
class Estimate:
    """A mean over seeds and the half width of its 95% confidence interval (Student's t).

    Args:
        mean: of the seeds' values.
        half_width: None for a single seed, which says nothing about others.
        seeds: how many.
    """

    mean: float
    half_width: float | None
    seeds: int


def estimate(values: list[float]) -> Estimate:
    """The mean of independent values with its confidence interval.

    Args:
        values: one per seed, at least one.
    """
    n = len(values)
    if n < 2:
        return Estimate(float(values[0]), None, n)
    half = stats.t.ppf(0.975, n - 1) * np.std(values, ddof=1) / np.sqrt(n)
    return Estimate(float(np.mean(values)), float(half), n)


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
        """Method, normals where they are no matter of course, and detail, in one line."""
        plain = self.method == "DeepSDF" and self.normals == "off"
        words = "" if plain else {"on": " + normals", "off": ", no normals"}.get(self.normals, "")
        return f"{self.method}{words}{f' ({self.detail})' if self.detail else ''}"

    @property
    def done(self) -> list[Cell]:
        return [cell for cell in self.cells if cell.scores]

    def has_surfaces(self, role: str = "known") -> bool:
        """Whether any judged shape has a surface: without one CD is a penalty, which says nothing."""
        return any(not shape.failed for cell in self.done for shape in cell.scores.shapes.get(role, []))

    def estimate(self, quantity: str, role: str = "known") -> Estimate | None:
        """A quantity over the finished seeds; None where no seed has it.

        Args:
            quantity: `cd_mean`, `cd_median`, `excess_mean`, `excess_median` (normalised units squared, shapes
                without a surface counted with their penalty), `normals_mean` (|cos| between normals, shapes
                with a surface), `floor_mean`, `no_surface` (shapes), `sdf_error_mean`, `sdf_error_median`,
                `sign_accuracy_mean` (of sources without meshes), `seconds`, `parameters`, `steps`, `epochs`,
                `samples` or `trained_on`.
            role: `known` or `held_out`; costs do not depend on it.
        """
        values = [_value(cell, quantity, role) for cell in self.done]
        kept = [value for value in values if value is not None]
        return estimate(kept) if kept else None


def _value(cell: Cell, quantity: str, role: str) -> float | None:
    scores = cell.scores
    if quantity in ("seconds", "parameters", "steps"):
        return getattr(scores.training, quantity)
    if quantity in ("epochs", "samples", "trained_on"):
        return getattr(scores, quantity)
    by_distance = quantity.startswith(("sdf_error", "sign_accuracy"))
    shapes = (scores.distances if by_distance else scores.shapes).get(role)
    if not shapes:
        return None
    if quantity == "no_surface":
        return sum(shape.failed for shape in shapes)
    what, statistic = quantity.rsplit("_", 1)
    field = {"cd": "counted_cd", "normals": "normal_consistency"}.get(what, what)
    values = [value for shape in shapes if (value := getattr(shape, field)) is not None]
    if not values:
        return None
    return float({"mean": np.mean, "median": np.median}[statistic](values))


@dataclass(frozen=True)
class Group:
    """Rows that may be compared: the same sweep, shapes, scale and way of judging.

    Args:
        choices: what they share of OF_THE_GROUP.
        told: names of choices that a title tells: without one, groups of the sweep would share a title.
        said: settings of the command line that decide which shapes are judged, and how.
        settings: values on the command line that all of them share beside.
        rows: in the order of the paper, then of the command.
    """

    choices: dict[str, str]
    told: list[str]
    said: dict[str, str]
    settings: dict[str, str]
    rows: list[Row]

    @cached_property
    def title(self) -> str:
        """`chairs, data=open, scale=cpu, trained on 20`; settings of all rows stand below a table."""
        return ", ".join(self.title_parts)

    @property
    def title_parts(self) -> list[str]:
        """The words of the title, the category first."""
        shapes = sorted({cell.scores.trained_on for row in self.rows for cell in row.done})
        counted = (
            [f"trained on {' to '.join(map(str, dict.fromkeys((shapes[0], shapes[-1]))))}"] if shapes else []
        )
        named = [f"{name}={self.choices[name]}" for name in self.told if name in self.choices]
        named += [f"{key}={value}" for key, value in self.said.items()]
        return [self.choices.get("category", "all"), *named, *counted]

    def row(self, method: str, normals: str) -> Row | None:
        """The row of that method, where there is one and no other."""
        of_method = self.rows_of(method, normals)
        return of_method[0] if len(of_method) == 1 else None

    def rows_of(self, method: str, normals: str) -> list[Row]:
        """The rows of that method; several where they differ in a setting."""
        return [row for row in self.rows if (row.method, row.normals) == (method, normals)]

    def rival(self, row: Row) -> Row | None:
        """The row of DeepSDF as published that a row is measured by: of equal settings, or the only one."""
        rivals = self.rows_of("DeepSDF", "off")
        alike = [rival for rival in rivals if rival.detail == row.detail]
        return alike[0] if len(alike) == 1 else rivals[0] if len(rivals) == 1 else None


def group_cells(cells: list[Cell]) -> list[Group]:
    """The cells of a sweep as groups of rows."""
    by_group: dict[tuple, list[Cell]] = {}
    for cell in cells:
        choices = tuple(cell.plan.choices.get(name) for name in OF_THE_GROUP)
        by_group.setdefault((choices, tuple(_of_the_group(cell).items())), []).append(cell)
    of_all = [dict(zip(OF_THE_GROUP, choices, strict=True)) for choices, _ in by_group]
    told = [
        name
        for name in OF_THE_GROUP
        if name in ("data", "scale")
        or (name != "category" and len({choices[name] for choices in of_all}) > 1)
    ]
    return [_group(members, told) for members in by_group.values()]


def _of_the_group(cell: Cell) -> dict[str, str]:
    """Settings of the command line that decide which shapes are judged, and how."""
    return {
        key: value
        for key, value in sorted(cell.plan.settings.items())
        if key.startswith(("data.", "evaluate.", "scale.small_table")) and not key.startswith("data.loader.")
    }


def _group(cells: list[Cell], told: list[str]) -> Group:
    said = _of_the_group(cells[0])
    common = set.intersection(*(set(cell.plan.settings.items()) for cell in cells))
    by_row: dict[tuple, list[Cell]] = {}
    for cell in cells:
        own = tuple(sorted(set(cell.plan.settings.items()) - common))
        others = tuple(sorted(pair for pair in cell.plan.choices.items() if pair[0] not in OF_THE_GROUP))
        by_row.setdefault((own, others), []).append(cell)
    names = {key: (_method(dict(key[1])), dict(key[1]).get("normals", "?")) for key in by_row}
    rows = [
        Row(*names[key], ", ".join(filter(None, [own, differing])), seeds)
        for key, members in by_row.items()
        for own in [_detail(key, [k for k in by_row if names[k] == names[key]])]
        for differing, seeds in _alike(members)
    ]
    rows.sort(key=lambda row: (rank(row.method), row.normals != "on"))
    choices = {name: cells[0].plan.choices[name] for name in OF_THE_GROUP if name in cells[0].plan.choices}
    return Group(choices, told, said, dict(sorted(common - set(said.items()))), rows)


def _alike(cells: list[Cell]) -> list[tuple[str, list[Cell]]]:
    """Seeds of one command line, apart where they were trained under different settings.

    Defaults change between two versions, and the command line does not tell it. What has no scores yet goes
    with the last.

    Returns:
        The settings that tell them apart, in words, and the cells.
    """
    found: list[tuple[dict, list[Cell]]] = []
    for cell in cells:
        if cell.scores:
            settings = {k: v for k, v in deciding(cell.scores.config).items() if k not in OF_THE_SEED}
            members = next((members for one, members in found if one == settings), None)
            if members is None:
                found.append((settings, members := []))
            members.append(cell)
    if len(found) < 2:
        return [("", cells)]
    found[-1][1].extend(cell for cell in cells if not cell.scores)
    by_values: dict[tuple, str] = {}
    for key in sorted({key for one, _ in found for key in one}):
        whole = [str(one.get(key, "unset")) for one, _ in found]
        short = [_shortened(value) for value in whole]
        values = tuple(short if len(set(short)) == len(set(whole)) else whole)
        if len(set(values)) > 1:
            by_values.setdefault(values, key)  # interpolated into other places it is told once
    return [
        (", ".join(f"{key}={values[k]}" for values, key in by_values.items()), members)
        for k, (_, members) in enumerate(found)
    ]


def _method(choices: dict[str, str]) -> str:
    if choices.get("decoder") == "deepsdf" and choices.get("activation") == "relu":
        return "DeepSDF" if choices.get("encoding") == "none" else f"{_encoding(choices)}DeepSDF"
    return f"{_encoding(choices)}{choices.get('activation', '?').upper()}"


def _encoding(choices: dict[str, str]) -> str:
    encoding = choices.get("encoding", "none")
    return PREFIXES.get(encoding, f"{encoding.upper()}/")


def rank(method: str) -> int:
    """The place of a method among the paper's rows."""
    return ORDER.index(method) if method in ORDER else len(ORDER)


def _detail(key: tuple, namesakes: list[tuple]) -> str:
    """Settings of the row's own, and choices only where rows of its name differ in them."""
    own, others = key
    common = set.intersection(*(set(k[1]) for k in namesakes))
    told = dict.fromkeys([*own, *(pair for pair in others if pair not in common)])
    return ", ".join(f"{name}={_shortened(value)}" for name, value in told)


def _shortened(value: str) -> str:
    """A number of more than six characters to three digits: a search draws them with sixteen."""
    try:
        return f"{float(value):.3g}" if len(value) > 6 else value
    except ValueError:
        return value


def duration(seconds: float) -> str:
    """`4.8 s`, `48 s`, `12.5 min`, `30.2 h`."""
    if seconds < 120:
        return f"{seconds:.1f} s" if seconds < 10 else f"{seconds:.0f} s"
    return f"{seconds / 60:.1f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
