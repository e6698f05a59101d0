"""What a sweep consists of: `sweep.json` in its folder lists the cells, finished or not. Plain data.

A cell is one training. Its folder is named after all its settings, so cells of another scale, category or
seed lie side by side, and a cell whose settings have changed since is superseded, not overwritten.
"""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, StringConstraints, ValidationError

from sdfhub.errors import SdfhubError
from sdfhub.locks import locked
from sdfhub.whole_file import write_whole

PLAN, FAILURE = "sweep.json", "failed.json"

Text = Annotated[str, StringConstraints(max_length=2000)]


class PlannedCell(BaseModel):
    """One cell as its command line described it.

    Args:
        folder: name of its folder below the sweep's.
        choices: option by config group, `sweeps` among them.
        settings: values set beside the groups and the seed, by dotted key.
        seed: of the training.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    folder: Annotated[str, StringConstraints(pattern=r"^[^./\\][^/\\]*$", max_length=255)]
    choices: dict[Text, Text]
    settings: dict[Text, Text]
    seed: int

    @property
    def identity(self) -> tuple:
        """What the command line said: two cells that agree in it are one, under old and new defaults."""
        return tuple(sorted(self.choices.items())), tuple(sorted(self.settings.items())), self.seed


class Plan(BaseModel):
    """The content of `sweep.json`."""

    model_config = ConfigDict(extra="forbid")

    version: Literal[1] = 1
    cells: list[PlannedCell] = []
    commands: list[Text] = []


def read_plan(sweep: Path) -> Plan:
    """What a sweep's folder consists of: its cells in the order of their commands, and these.

    Raises:
        SdfhubError: it is not a sweep's folder, or `sweep.json` is broken.
    """
    try:
        return Plan.model_validate_json((sweep / PLAN).read_bytes())
    except OSError as error:
        one_run = "; it is that of one run" if (sweep / "metrics.json").exists() else ""
        raise SdfhubError(
            f"{sweep}: not the folder of a multirun, such as outputs/sweeps/table_small "
            f"({PLAN}: {(error.strerror or 'unreadable').lower()}){one_run}"
        ) from error
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"])) or "content"
        raise SdfhubError(f"{sweep / PLAN}: {place}: {first['msg'].lower()}") from error


def enter_cells(sweep: Path, cells: Iterable[PlannedCell], command: str | None = None) -> None:
    """Adds cells to `sweep.json`, and the command that asked for them. Safe side by side.

    A cell whose settings have changed is replaced.
    """
    sweep.mkdir(parents=True, exist_ok=True)
    with locked(sweep / ".lock"):
        old = read_plan(sweep) if (sweep / PLAN).exists() else Plan()
        known = {cell.identity: cell for cell in (*old.cells, *cells)}
        wordy_first = sorted(known.values(), key=lambda cell: -len(cell.settings))
        shortest = {cell.folder: cell for cell in wordy_first}  # a default said or left out is one cell
        by_folder = {cell.folder: shortest[cell.folder] for cell in known.values()}
        commands = dict.fromkeys([*old.commands, *([command[:2000]] if command else [])])
        plan = Plan(cells=list(by_folder.values()), commands=list(commands))
        write_whole(sweep / PLAN, json.dumps(plan.model_dump(), indent=1).encode())
