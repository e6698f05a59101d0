"""A multirun from its plan to its report; each cell trained once, continued, its failure written down."""

import json
import logging
import os
import shlex
import sys
import traceback
from collections.abc import Callable
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from sdfhub.composition import one_line, plain
from sdfhub.errors import SdfhubError
from sdfhub.multirun.names import choices_of, register_resolvers
from sdfhub.report.results import FAILURE, PlannedCell, enter_cells, read_plan, read_scores
from sdfhub.settings import WHERE_NOT_WHAT, settings_digest
from sdfhub.whole_file import write_whole

Train = Callable[[DictConfig, Path], dict[str, Any]]  # of a config into a folder: what `metrics.json` holds
WATCHING_GROUPS = ("callbacks", "logger", "debug", "paths", "extras")
UNNAMED = {"conditioning", "decoder", "loss", "optim"}  # groups that name no row: they count as settings

log = logging.getLogger(__name__)


class SweepRecord(Callback):
    """`sweep.json` before the first cell, the report after the last; status 1 where a cell failed."""

    _cells: list[PlannedCell] = []  # noqa: RUF012 - replaced, never changed

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__ = state
        register_resolvers()  # a launcher's worker unpickles this before it reads a config

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        if config.hydra.job.config_name != "config":  # preparation makes no cells
            return
        words = _words(config.hydra)
        asked = [word for word in words if word.startswith(("sweeps=", "hparams_search="))]
        try:
            if len(asked) > 1 or "," in "".join(asked):  # Hydra would train the cells of none of them
                raise ValueError(f"{' '.join(asked)}: one sweep or search a command")
            self._cells = planned_cells(config)
        except (HydraException, OmegaConfBaseException):
            return  # the sweeper composes the same cells, and its error is worded for the user
        except ValueError as error:
            print(f"sdfhub: error: {one_line(error)}", file=sys.stderr)
            sys.exit(2)  # what a callback raises, Hydra makes a warning of
        words += [word for word in _words(config.hydra, "hydra") if not word.startswith("hydra.mode=")]
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
            log.error("no report: %s; to try again: sdfhub report %s", one_line(error), sweep)
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
    words = [f"{key}={value}" for key, value in params.items()] + _words(config.hydra)
    overrides = OverridesParser.create(config_loader=loader).parse_overrides(words)
    (jobs,) = BasicSweeper.split_arguments(overrides, max_batch_size=None)
    cells = [loader.load_sweep_config(config, job) for job in jobs]
    return [planned_cell(cell, cell.hydra, str(cell.hydra.sweep.subdir)) for cell in cells]


def _words(hydra: DictConfig, part: str = "task") -> list[str]:
    """The overrides of the command line as they were typed, `${oc.env:...}` too."""
    return list(map(str, OmegaConf.to_container(hydra.overrides[part], resolve=False) or ()))


def run_cell(train: Train, config: DictConfig, hydra: DictConfig) -> dict[str, Any]:
    """Trains a cell of a multirun unless it is finished; returns what `metrics.json` holds.

    A cell that fails leaves `failed.json` and raises nothing: the others go on, under any launcher.
    """
    folder = Path(hydra.runtime.output_dir)
    # ddp processes that SLURM or torchrun started train a cell together: the first holds the lock for all
    follows = any(os.environ.get(rank, "0") != "0" for rank in ("SLURM_PROCID", "RANK"))
    try:
        with nullcontext() if follows else FileLock(folder / ".lock", timeout=0):
            enter_cells(folder.parent, [planned_cell(config, hydra, folder.name)])
            return go_on(train, config, folder)
    except Timeout:
        log.warning("%s: another process trains it", folder)
    except Exception as error:
        failure = {"reason": one_line(error), "traceback": "".join(traceback.format_exception(error))}
        write_whole(folder / FAILURE, json.dumps(failure, indent=1))
        log.error("%s: %s", folder.name, failure["reason"])
    return {}


def go_on(train: Train, config: DictConfig, folder: Path) -> dict[str, Any]:
    """Trains into a folder, from its last checkpoint on; a finished run only returns its metrics."""
    (folder / FAILURE).unlink(missing_ok=True)
    if (metrics := finished(folder, plain(config))) is not None:
        log.info("%s: finished before", folder)
        return metrics
    checkpoint = folder / "checkpoints" / "last.ckpt"
    if config.ckpt_path is None and checkpoint.is_file():
        log.info("%s: continues from %s", folder, checkpoint.name)
        OmegaConf.update(config, "ckpt_path", str(checkpoint))
    return train(config, folder)


def finished(folder: Path, config: dict[str, Any]) -> dict[str, Any] | None:
    """The metrics of a run that was trained and judged under these settings; None where it was not."""
    with suppress(OSError, SdfhubError):
        trained = read_scores(folder).config  # raises where a report could not read the scores
        if settings_digest(trained) == settings_digest(config):
            return json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
    return None


def planned_cell(config: DictConfig, hydra: DictConfig, folder: str) -> PlannedCell:
    """A composed cell as `sweep.json` keeps it; a ValueError for a seed that is no whole number."""
    choices = choices_of(config, hydra)
    pairs = [word.lstrip("+~").partition("=") for word in _words(hydra)]
    other = ("seed", *WHERE_NOT_WHAT)
    settings = {k: v for k, _, v in pairs if not k.startswith(other) and k not in choices.keys() - UNNAMED}
    choices = {group: choice for group, choice in choices.items() if group not in WATCHING_GROUPS}
    return PlannedCell(folder=folder, choices=choices, settings=settings, seed=config.seed)
