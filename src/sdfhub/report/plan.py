"""What a sweep consists of: `sweep.json` in its folder lists the cells, finished or not. Plain data.

A cell is one training. Its folder is named after all its settings: cells of another scale, category or seed
lie side by side, and a cell whose settings have changed since is superseded, not overwritten.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, StringConstraints, ValidationError

from sdfhub.errors import SdfhubError
from sdfhub.locks import locked
from sdfhub.whole_file import write_whole

PLAN, FAILURE = "sweep.json", "failed.json"

Text = Annotated[str, StringConstraints(max_length=2000)]
FolderName = Annotated[str, StringConstraints(pattern=r"^[^./\\][^/\\]*$", max_length=255)]


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
    try:
        return Plan.model_validate_json((sweep / PLAN).read_bytes())
    except OSError as error:
        raise SdfhubError(f"{sweep}: not the folder of a multirun: it has no {PLAN}") from error
    except ValidationError as error:
        raise SdfhubError(f"{sweep / PLAN}: {first_fault(error)}") from error


def first_fault(error: ValidationError) -> str:
    """Where the first fault of checked data lies, and what it is."""
    fault = error.errors()[0]
    return f"{'.'.join(map(str, fault['loc']))}: {fault['msg'].lower()}"


def enter_cells(sweep: Path, cells: Iterable[PlannedCell], command: str | None = None) -> None:
    """Adds cells to `sweep.json`, and the command that asked for them. Safe side by side.

    A cell whose settings have changed is replaced. Of cells with one folder the one with the fewest settings
    stays: the others name defaults.
    """
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
