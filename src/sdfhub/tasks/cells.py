"""One cell of a sweep: trained once, continued where it was interrupted, and its failure written down."""

import json
import os
import sys
import traceback
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from sdfhub.errors import SdfhubError
from sdfhub.locks import locked
from sdfhub.report.plan import FAILURE, PlannedCell, enter_cells
from sdfhub.report.results import read_scores
from sdfhub.settings import WHERE_NOT_WHAT, settings_digest
from sdfhub.tasks.build import Seed, check, plain
from sdfhub.tasks.wording import one_line
from sdfhub.whole_file import write_whole

TASKS = ("SLURM_PROCID", "RANK")
"""Where SLURM, and torchrun, say which of the processes that they started together this is."""

UNTOLD_GROUPS = ("callbacks", "tuned")
"""Groups that say how watched a cell is, or follow from the others unless they are said."""

TOLD_IF_SAID = ("tuned", "conditioning", "decoder", "loss", "optim")
"""Groups that no name of a row tells: said on the command line they count as settings."""


def run_cell(
    train: Callable[[dict[str, Any], Path], dict[str, Any]], config: DictConfig, hydra: DictConfig
) -> dict[str, Any]:
    """Trains a cell of a sweep unless it is finished or another process has it in hand.

    A cell that was interrupted goes on from its last checkpoint. One that fails leaves `failed.json` with the
    reason and a line on stderr, and raises nothing: the other cells go on, under any launcher.

    Args:
        train: trains what a plain config describes into a folder and returns its metrics.
        config: composed, without Hydra's own part.
        hydra: Hydra's own part.

    Returns:
        What `metrics.json` holds; empty for a cell that failed or that another process trains.
    """
    folder = Path(hydra.runtime.output_dir)
    folder.mkdir(parents=True, exist_ok=True)
    enter_cells(folder.parent, [planned_cell(config, hydra, folder.name)])
    with in_hand(folder) as ours:
        if not ours:
            print(f"cell: {folder}: another process is training it", flush=True)
            return {}
        try:
            return go_on(train, plain(config), folder)
        except Exception as error:
            _write_failure(folder, error)
            return {}


def in_hand(folder: Path) -> AbstractContextManager[bool]:
    """Whether this process may train a cell: no other does, or the others train it together with this one.

    Of the processes that SLURM starts for ddp all come here; the first one holds the lock for them.
    """
    if any(os.environ.get(name, "0") != "0" for name in TASKS):
        return nullcontext(True)
    return locked(folder / ".lock", patience=1)  # a report holds it for a moment, a training for hours


def go_on(
    train: Callable[[dict[str, Any], Path], dict[str, Any]],
    config: dict[str, Any],
    folder: Path,
) -> dict[str, Any]:
    """Trains what a plain config describes into a folder, from where an earlier training into it ended.

    Args:
        train, folder: as for `run_cell`.
        config: plain.
    """
    metrics = finished(folder, config)
    (folder / FAILURE).unlink(missing_ok=True)
    if metrics is not None:
        print(f"run: {folder}: finished before", flush=True)
        return metrics
    checkpoint = folder / "checkpoints" / "last.ckpt"
    if config["ckpt_path"] is None and checkpoint.is_file():
        print(f"run: {folder}: goes on from {checkpoint.name}", flush=True)
        config["ckpt_path"] = str(checkpoint)
    return train(config, folder)


def finished(folder: Path, config: dict[str, Any]) -> dict[str, Any] | None:
    """The metrics of a cell that was trained and judged under these very settings; None where it was not.

    What a report could not read is not finished.
    """
    try:
        then = read_scores(folder).config
        metrics = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
    except (OSError, SdfhubError):
        return None
    return metrics if settings_digest(then) == settings_digest(config) else None


def planned_cell(config: DictConfig, hydra: DictConfig, folder: str) -> PlannedCell:
    """A composed cell as `sweep.json` keeps it.

    Raises:
        SdfhubError: a seed that is none.
    """
    seed = check(config.seed, Seed, "seed")
    groups = {name: choice for name, choice in hydra.runtime.choices.items() if "/" not in name}
    said = (override.lstrip("+~").partition("=") for override in hydra.overrides.task)
    return PlannedCell(
        folder=folder,
        choices={
            name: str(choice) for name, choice in groups.items() if choice and name not in UNTOLD_GROUPS
        },
        settings={
            key: value
            for key, _, value in said
            if (key not in groups or key in TOLD_IF_SAID)
            and key != "seed"
            and not key.startswith(WHERE_NOT_WHAT)
        },
        seed=seed,
    )


def _write_failure(folder: Path, error: Exception) -> None:
    told = one_line(error)
    reason = told if str(error) else type(error).__name__
    trace = "".join(traceback.format_exception(error))
    write_whole(folder / FAILURE, json.dumps({"reason": reason, "traceback": trace}, indent=1))
    print(f"sdfhub: error: {folder.name}: {reason}", file=sys.stderr, flush=True)
