"""One cell of a multirun: trained once, continued where it was interrupted, its failure written down."""

import json
import logging
import os
import traceback
from collections.abc import Callable
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from omegaconf import DictConfig, OmegaConf

from sdfhub.composition import plain
from sdfhub.errors import SdfhubError
from sdfhub.multirun.names import choices_of
from sdfhub.report.results import FAILURE, PlannedCell, enter_cells, read_scores
from sdfhub.settings import WHERE_NOT_WHAT, settings_digest
from sdfhub.whole_file import write_whole

Train = Callable[[DictConfig, Path], dict[str, Any]]
"""Trains what a composed config describes into a folder; returns what `metrics.json` holds."""

WATCHING_GROUPS = ("callbacks", "logger", "debug", "paths", "extras")
UNNAMED = {"conditioning", "decoder", "loss", "optim"}  # groups that name no row: they count as settings

log = logging.getLogger(__name__)


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
        reason = " ".join(str(error).split()) or type(error).__name__
        failure = {"reason": reason, "traceback": "".join(traceback.format_exception(error))}
        write_whole(folder / FAILURE, json.dumps(failure, indent=1))
        log.error("%s: %s", folder.name, reason)
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
    words: Any = OmegaConf.to_container(hydra.overrides.task, resolve=False)  # ${oc.env:...} as written
    pairs = [word.lstrip("+~").partition("=") for word in words]
    other = ("seed", *WHERE_NOT_WHAT)
    settings = {k: v for k, _, v in pairs if not k.startswith(other) and k not in choices.keys() - UNNAMED}
    choices = {group: choice for group, choice in choices.items() if group not in WATCHING_GROUPS}
    return PlannedCell(folder=folder, choices=choices, settings=settings, seed=config.seed)
