"""A multirun from its plan to its report: a Hydra callback."""

import logging
import shlex
import sys
from pathlib import Path
from typing import Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from sdfhub.multirun.cells import planned_cell
from sdfhub.multirun.names import register_resolvers
from sdfhub.report.results import FAILURE, PlannedCell, enter_cells, read_plan

log = logging.getLogger(__name__)


class SweepRecord(Callback):
    """`sweep.json` before the first cell, the report after the last; status 1 where a cell failed."""

    def __init__(self) -> None:
        self._cells: list[PlannedCell] = []

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__ = state
        register_resolvers()  # a launcher's worker unpickles this before it reads a config

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        if config.hydra.job.config_name != "config":  # preparation makes no cells
            return
        words = _words(config)
        asked = [word for word in words if word.startswith(("sweeps=", "hparams_search="))]
        refused = ""
        if len(asked) > 1 or "," in "".join(asked):  # Hydra would train the cells of none of them
            refused = f"{' '.join(asked)}: one sweep or search a command"
        try:
            self._cells = [] if refused else planned_cells(config)
        except (HydraException, OmegaConfBaseException):
            return  # the sweeper composes the same cells, and its error is worded for the user
        except ValueError as error:
            refused = " ".join(str(error).split())
        if refused:
            print(f"sdfhub: error: {refused}", file=sys.stderr)
            sys.exit(2)  # what a callback raises, Hydra makes a warning of
        words += [word for word in _words(config, "hydra") if not word.startswith("hydra.mode=")]
        command = shlex.join(["python", "train.py", "-m", *words])
        enter_cells(Path(config.hydra.sweep.dir), self._cells, command)

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        if config.hydra.job.config_name != "config":  # preparation makes no cells
            return
        from sdfhub.tasks.report import write_report  # here: Hydra imports this file at every start

        sweep = Path(config.hydra.sweep.dir)
        try:
            write_report(sweep, sweep / "report")
        except Exception as error:  # Hydra would make a warning of it, and never come to the exit status
            log.error("no report: %s; to try again: sdfhub report %s", " ".join(str(error).split()), sweep)
        cells = self._cells or read_plan(sweep).cells
        if failed := sum((sweep / cell.folder / FAILURE).exists() for cell in cells):
            log.error("%d of %d cells failed", failed, len(cells))
            sys.exit(1)


def planned_cells(config: DictConfig) -> list[PlannedCell]:
    """The cells that Hydra's own sweeper will train; [] under a sweeper that decides as it goes."""
    if not str(config.hydra.sweeper._target_).endswith(".BasicSweeper"):
        return []
    loader = GlobalHydra.instance().config_loader()
    params: Any = OmegaConf.to_container(config.hydra.sweeper.params or OmegaConf.create({}))
    words = [f"{key}={value}" for key, value in params.items()] + _words(config)
    overrides = OverridesParser.create(config_loader=loader).parse_overrides(words)
    (jobs,) = BasicSweeper.split_arguments(overrides, max_batch_size=None)
    cells = [loader.load_sweep_config(config, job) for job in jobs]
    return [planned_cell(cell, cell.hydra, str(cell.hydra.sweep.subdir)) for cell in cells]


def _words(config: DictConfig, part: str = "task") -> list[str]:
    """The overrides of the command line as they were typed."""
    return list(map(str, OmegaConf.to_container(config.hydra.overrides[part], resolve=False) or ()))
