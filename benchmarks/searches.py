"""What searches for settings found: the best trials of each beside the defaults, trained alike.

    python train.py -m search=fft_hosc scale=demo                  # a search, for each row
    python train.py experiment=fft_hosc scale=demo hydra.run.dir=SWEEP_DIR/defaults
    python benchmarks/searches.py SWEEP_DIR ... [--best 3] [--csv trials.csv]

A search's folder holds a folder of each training; that of the defaults, named `defaults`, is optional. The
objective is what the search lowered: the geometric mean of known and held-out shapes' median excess CD, times
10^3. Settings are those in which its trainings differ. Trials that failed are counted and have no objective.
"""

import argparse
import csv
import io
import json
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from sdfhub.tasks.names import flat
from sdfhub.tasks.search import objective
from sdfhub.whole_file import write_whole

DEFAULTS = "defaults"


class Trial(NamedTuple):
    """One training: its folder, flat settings, objective times 10^3 (None: failed), training seconds."""

    name: str
    settings: dict[str, Any]
    objective: float | None
    seconds: float | None


def read_trial(folder: Path) -> Trial:
    settings = flat(yaml.safe_load((folder / "config.yaml").read_text(encoding="utf-8")))
    try:
        metrics = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
    except FileNotFoundError:
        return Trial(folder.name, settings, None, None)
    value = objective(metrics)
    return Trial(
        folder.name, settings, None if value is None else value * 1e3, metrics["training"]["seconds"]
    )


def read_search(folder: Path) -> tuple[list[Trial], Trial | None, list[str]]:
    """A search's trials, the best first, the defaults, and the names of the settings that were searched."""
    found = [read_trial(path.parent) for path in sorted(folder.glob("*/config.yaml"))]
    trials = [trial for trial in found if trial.name != DEFAULTS]
    trials.sort(key=lambda trial: float("inf") if trial.objective is None else trial.objective)
    keys = trials[0].settings if trials else {}
    own = [key for key in keys if not key.startswith(("decoder.", "scale."))]  # these repeat others
    searched = [key for key in own if len({str(trial.settings.get(key)) for trial in trials}) > 1]
    return trials, next((trial for trial in found if trial.name == DEFAULTS), None), searched


def line(rank: str, trial: Trial, searched: list[str]) -> str:
    settings = ", ".join(f"{key}={shown(trial.settings.get(key))}" for key in searched)
    value = "failed" if trial.objective is None else f"{trial.objective:.4f}"
    return f"| {rank} | {value} | {shown(trial.seconds)} | {settings} |"


def shown(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def write_csv(path: Path, searches: dict[str, list[Trial]], keys: list[str]) -> None:
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(["search", "objective", "seconds", *keys])
    for name, trials in searches.items():
        for trial in trials:
            rows.writerow([name, trial.objective, trial.seconds, *map(trial.settings.get, keys)])
    write_whole(path, text.getvalue())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("searches", nargs="+", type=Path, help="folders of searches")
    parser.add_argument("--best", type=int, default=3)
    parser.add_argument("--csv", type=Path, help="all trials")
    arguments = parser.parse_args()
    all_trials, all_keys = {}, []
    for folder in arguments.searches:
        trials, defaults, searched = read_search(folder)
        failed = sum(trial.objective is None for trial in trials)
        print(f"\n{folder.name}: {len(trials)} trials, {failed} failed\n")
        print("| rank | excess | training s | settings |\n| --- | --- | --- | --- |")
        for rank, trial in enumerate(trials[: arguments.best], 1):
            print(line(str(rank), trial, searched))
        if defaults:
            print(line("defaults", defaults, searched))
        all_trials[folder.name] = trials + ([defaults] if defaults else [])
        all_keys += [key for key in searched if key not in all_keys]
    if arguments.csv:
        write_csv(arguments.csv, all_trials, all_keys)


if __name__ == "__main__":
    main()
