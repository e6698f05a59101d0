"""A multirun from its first cell to its report: what is planned, what came of it, the exit status."""

import shlex
import sys
from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf, open_dict
from pydantic import PositiveInt

from sdfhub.errors import SdfhubError
from sdfhub.locks import locked
from sdfhub.report.plan import FAILURE, PlannedCell, enter_cells, read_plan
from sdfhub.tasks.app import refuse_strangers, register_resolvers
from sdfhub.tasks.build import Seed, check
from sdfhub.tasks.cells import planned_cell
from sdfhub.tasks.wording import one_line

EXTRAS = {"submitit": "slurm", "joblib": "joblib", "optuna": "optuna"}
"""What to install of sdfhub for a launcher or sweeper, by the name of its plugin."""

MULTIRUNS = ("sweeps", "search")
"""Groups whose choices say what a multirun's cells are."""


class SweepRecord(Callback):
    """Writes `sweep.json` before the first cell and the report after the last one.

    The process ends with status 1 where a cell of this command failed.
    """

    def __init__(self) -> None:
        self._planned: list[PlannedCell] = []

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__ = state
        register_resolvers()  # a launcher's worker unpickles this before it reads a config

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        try:
            refuse_missing_plugins(config)
            refuse_second_multirun(config.hydra)
            refuse_strangers(config, config.hydra.job.config_name, config.hydra)
            if not _is_training(config):
                return
            if config.hydra.runtime.choices.get("search"):
                refuse_bad_budget(OmegaConf.select(config, "search.trials"))
                check(config.seed, Seed, "seed")  # planning a sweep checks that of each cell
            self._planned = planned_cells(config)
        except (SdfhubError, HydraException) as error:  # here, before the sweeper makes a folder
            print(f"sdfhub: error: {one_line(error, config.hydra.job.config_name)}", file=sys.stderr)
            sys.exit(2)
        except Exception as error:  # such as a folder's name that only its job will know
            print(f"sdfhub: the sweep cannot be planned: {one_line(error)}", file=sys.stderr)
            return
        if config.hydra.runtime.choices.get("search"):
            hold_search(Path(config.hydra.sweep.dir))
        enter_cells(Path(config.hydra.sweep.dir), self._planned, command_line(config))

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        if not _is_training(config):
            return
        _held.close()
        from sdfhub.tasks.report import write_report  # here: Hydra imports this file at every start

        sweep = Path(config.hydra.sweep.dir)
        try:
            write_report(sweep, sweep / "report")
        except Exception as error:  # whatever it is, the cells' own failures are told
            print(f"sdfhub: error: no report: {one_line(error)}; sdfhub report {sweep}", file=sys.stderr)
        cells = self._planned or read_plan(sweep).cells
        failed = [cell for cell in cells if (sweep / cell.folder / FAILURE).exists()]
        if failed:
            print(f"sdfhub: error: {len(failed)} of {len(cells)} cells failed", file=sys.stderr)
            sys.exit(1)


_held = ExitStack()
"""The lock of the search that this process runs; an interrupted one lets go of it when the process ends."""


def hold_search(folder: Path) -> None:
    """Ends this process where another one runs the same search: both would draw and train the same trials."""
    _held.close()
    folder.mkdir(parents=True, exist_ok=True)
    if not _held.enter_context(locked(folder / ".search.lock", patience=0)):
        _held.close()
        print(f"sdfhub: error: {folder}: another process runs this search", file=sys.stderr)
        sys.exit(2)


def refuse_missing_plugins(config: DictConfig) -> None:
    """Refuses a launcher or sweeper whose package is not installed.

    Raises:
        SdfhubError: says what to install.
    """
    for role in ("launcher", "sweeper"):
        package = ".".join(str(config.hydra[role]._target_).split(".")[:2])
        name = next((name for name in EXTRAS if f"hydra_{name}_" in package), None)
        if name and (find_spec("hydra_plugins") is None or find_spec(package) is None):
            raise SdfhubError(
                f"hydra/{role}={config.hydra.runtime.choices[f'hydra/{role}']}: is not installed here; "
                f"pip install 'sdfhub[{EXTRAS[name]}]'"
            )


def refuse_second_multirun(hydra: DictConfig) -> None:
    """Refuses a command that asks for a sweep and a search, or for several of them.

    Rows and trials are the sweeper's, which a command has one of: of a second it would know nothing, and of
    `sweeps=a,b`, which is chosen cell by cell, neither.

    Args:
        hydra: Hydra's own part of a config.

    Raises:
        SdfhubError: names the groups.
    """
    for word in OverridesParser.create().parse_overrides(list(hydra.overrides.task)):
        if word.key_or_group in MULTIRUNS and word.is_sweep_override():
            raise SdfhubError(f"{word.input_line}: takes one name; start them one after another")
    if all(hydra.runtime.choices.get(group) for group in MULTIRUNS):
        raise SdfhubError("search= and sweeps=: a search is no table; leave one of them out")


def refuse_bad_budget(trials: Any) -> None:
    """Refuses a number of trials that is none, before a study is made for them.

    Raises:
        SdfhubError: names the key.
    """
    try:
        check(trials, PositiveInt, "search.trials")
    except SdfhubError as error:
        raise SdfhubError(f"search.trials={trials}: must be a whole number, at least 1") from error


def command_line(config: DictConfig) -> str:
    """The command of a multirun as one would type it again, wherever `train.py` lies."""
    said = [*config.hydra.overrides.task, *config.hydra.overrides.hydra]
    words = [word for word in said if not word.startswith("hydra.mode=")]
    return shlex.join(["python", "train.py", "-m", *words])


def planned_cells(config: DictConfig) -> list[PlannedCell]:
    """The cells that a multirun's command line stands for; [] under a sweeper that decides as it goes.

    Args:
        config: of the multirun, Hydra's own part included.

    Raises:
        SdfhubError: a key that nothing reads, or a seed that is none.
    """
    loader = GlobalHydra.instance().config_loader()
    cells = [loader.load_sweep_config(config, job) for job in jobs(config)]
    for cell in cells[:1]:  # all have the same keys
        refuse_strangers(cell, cell.hydra.job.config_name, cell.hydra)
    return [as_planned(cell) for cell in cells]


def jobs(config: DictConfig) -> list[list[str]]:
    """The overrides of each cell, as Hydra's own sweeper makes them."""
    if not str(config.hydra.sweeper._target_).endswith(".BasicSweeper"):
        return []
    params = OmegaConf.to_container(config.hydra.sweeper.params or OmegaConf.create({}))
    words = [f"{key}={value}" for key, value in params.items()] + list(config.hydra.overrides.task)
    parser = OverridesParser.create(config_loader=GlobalHydra.instance().config_loader())
    (batch,) = BasicSweeper.split_arguments(parser.parse_overrides(words), max_batch_size=None)
    return batch


def as_planned(config: DictConfig) -> PlannedCell:
    """A composed cell as `sweep.json` keeps it; Hydra's own part leaves the config."""
    with open_dict(config):
        folder = str(config.hydra.sweep.subdir)
        hydra = config.pop("hydra")
    return planned_cell(config, hydra, folder)


def _is_training(config: DictConfig) -> bool:
    """Preparation shares the training's config, but makes no cells."""
    return config.hydra.job.config_name == "config"
