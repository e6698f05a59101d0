"""What searches for settings found: the best trials of each beside the defaults, trained alike.

    python train.py -m hparams_search=fft_hosc scale=tiny                  # a search, for each row
    python train.py experiment=fft_hosc scale=tiny hydra.run.dir=SWEEP_DIR/defaults
    python benchmarks/searches.py SWEEP_DIR ... [--best 3] [--csv trials.csv]
    python benchmarks/searches.py trials.csv --only demo_fft_hosc --best 2 --enqueue OTHER_DIR
    python train.py -m hparams_search=fft_hosc scale=cpu hparams_search.trials=2 \\
        hydra.sweep.dir=OTHER_DIR  # tries them first

A search's folder holds a folder of each training; that of the defaults, named `defaults`, is optional. A file
that --csv wrote stands for the searches in it; of two searches of one name the later one counts. The
objective is what a search lowers: the geometric mean of mean and median excess CD of known and of held-out
shapes. Beside it both means and medians; all times 10^3. Settings are those that the search drew.
"""

import argparse
import csv
import io
import json
import re
import warnings
from pathlib import Path
from statistics import mean, median
from typing import NamedTuple

from runs import head, row

from sdfhub.errors import SdfhubError
from sdfhub.multirun.search import objective
from sdfhub.report.results import Scores, read_plan, read_scores, read_sweep
from sdfhub.settings import flat
from sdfhub.whole_file import write_whole

KEYS = re.compile(r"(?:^|\s)['\"]?[+~]*([^\s='\"]+)")
"""Keys of a command's words, quoted or not, whole or cut."""

SCORES = ("objective", "train", "train_median", "held_out", "held_out_median", "seconds")


class Trial(NamedTuple):
    """A training: rank or `defaults`, SCORES times 10^3, settings by key.

    Seconds are as they are; None stands for what was not judged: all of a training that failed.
    """

    name: str
    scores: dict[str, float | None]
    settings: dict[str, str]


def judged(folder: Path, scores: Scores | None) -> dict[str, float | None]:
    """SCORES of a training's folder."""
    if scores is None:
        return dict.fromkeys(SCORES)
    excess: dict[str, float | None] = dict.fromkeys(SCORES)
    for role, shapes in scores.shapes.items():
        values = [shape.excess * 1e3 for shape in shapes]
        excess |= {role: mean(values), f"{role}_median": median(values)}
    value = objective(json.loads((folder / "metrics.json").read_text(encoding="utf-8")))
    return excess | {"objective": value * 1e3, "seconds": scores.training.seconds}


def read_search(folder: Path) -> list[Trial]:
    """A search's finished and failed trials, the best first, then the defaults where they are there."""
    cells = [cell for cell in read_sweep(folder) if cell.state != "missing"]
    if not all("hparams_search" in cell.plan.choices for cell in cells):
        raise SdfhubError(f"{folder}: not a search; `sdfhub report` tells what a sweep found")
    said = [cell.plan.settings for cell in cells]
    everywhere = sorted(set.intersection(*map(set, said))) if said else []
    fixed = {key for command in read_plan(folder).commands for key in KEYS.findall(command)}
    searched = [key for key in everywhere if key not in fixed]
    found = [
        Trial("", scores, {key: shown(cell.plan.settings[key]) for key in searched})
        for cell in cells
        for scores in [judged(cell.folder, cell.scores if cell.state == "done" else None)]
    ]
    found.sort(key=lambda trial: trial.scores["objective"] or float("inf"))
    ranked = [trial._replace(name=str(rank)) for rank, trial in enumerate(found, 1)]
    defaults = folder / "defaults"
    if (defaults / "metrics.json").exists():
        scores = read_scores(defaults)
        settings = {key: shown(flat(scores.config)[key]) for key in searched}
        ranked.append(Trial("defaults", judged(defaults, scores), settings))
    return ranked


def read_csv(file: Path) -> dict[str, list[Trial]]:
    """The searches of a file that --csv wrote, by name."""
    searches: dict[str, list[Trial]] = {}
    try:
        rows = list(csv.DictReader(io.StringIO(file.read_text(encoding="utf-8"))))
        for row in rows:
            name, rank = row.pop("search"), row.pop("trial")
            scores = {key: float(value) if (value := row.pop(key)) else None for key in SCORES}
            settings = {key: value for key, value in row.items() if value}
            searches.setdefault(name, []).append(Trial(rank, scores, settings))
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise SdfhubError(f"{file}: not a table of trials as --csv writes it ({error})") from error
    return searches


def shown(value: float | int | str) -> str:
    """Three digits are all that a search can tell."""
    return f"{float(value):.3g}"


def print_best(trials: list[Trial], best: int) -> None:
    """A table of the best trials, and of the defaults."""
    head(" | ".join(["", *SCORES, *(trials[0].settings if trials else ())]))
    for trial in trials:
        if trial.name == "defaults" or int(trial.name) <= best:
            nothing = "failed" if trial.scores["objective"] is None else ""
            numbers = [nothing if value is None else f"{value:.4g}" for value in trial.scores.values()]
            row(trial.name, *numbers, *trial.settings.values())


def csv_text(searches: dict[str, list[Trial]]) -> str:
    """Every trial of every search, a line each."""
    every = [trial for trials in searches.values() for trial in trials]
    keys = list(dict.fromkeys(key for trial in every for key in trial.settings))
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(["search", "trial", *SCORES, *keys])
    for name, trials in searches.items():
        for trial in trials:
            scores = ["" if value is None else f"{value:.6g}" for value in trial.scores.values()]
            rows.writerow([name, trial.name, *scores, *(trial.settings.get(key, "") for key in keys)])
    return text.getvalue()


def enqueue(trials: list[Trial], other: Path, best: int) -> list[dict[str, float | int]]:
    """Puts the settings of the best trials first into another search, at another scale, say.

    What the other study has finished or still waits with is not asked again: after an interruption the
    same command brings back the trial that was lost.

    Returns:
        The settings that were put there.
    """
    import optuna  # an extra, and slow to import

    other.mkdir(parents=True, exist_ok=True)
    storage = f"sqlite:///{other / 'study.db'}"
    target = optuna.create_study(study_name="search", storage=storage, load_if_exists=True)
    known = [
        {key: shown(value) for key, value in (trial.params or trial.system_attrs["fixed_params"]).items()}
        for trial in target.trials
        if trial.state.is_finished() or trial.state is optuna.trial.TrialState.WAITING
    ]
    done = [trial for trial in trials if trial.name != "defaults" and trial.scores["objective"] is not None]
    asked = [
        {key: number(value) for key, value in trial.settings.items()}
        for trial in done[:best]
        if trial.settings not in known
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        for settings in asked:
            target.enqueue_trial(settings)
    return asked


def number(text: str) -> float | int:
    """Optuna refuses a float where a search draws integers."""
    return int(text) if text.isdigit() else float(text)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("searches", nargs="+", type=Path, help="folders of searches, or files of --csv")
    parser.add_argument("--only", help="the search of this name")
    parser.add_argument("--best", type=int, default=3)
    parser.add_argument("--csv", type=Path, help="all trials")
    parser.add_argument("--enqueue", type=Path, help="folder of another search, which tries the best first")
    arguments = parser.parse_args()
    searches: dict[str, list[Trial]] = {}
    for source in arguments.searches:
        searches |= read_csv(source) if source.is_file() else {source.name: read_search(source)}
    if arguments.only:
        searches = {arguments.only: searches[arguments.only]}
    for name, trials in searches.items():
        failed = sum(trial.scores["objective"] is None for trial in trials)
        print(f"\n### {name}: {sum(trial.name != 'defaults' for trial in trials)} trials, {failed} failed")
        print_best(trials, arguments.best)
    if arguments.enqueue:
        for name, trials in searches.items():
            count = len(enqueue(trials, arguments.enqueue, arguments.best))
            print(f"\n{arguments.enqueue}: {count} settings of {name} come first")
    if arguments.csv:
        write_whole(arguments.csv, csv_text(searches))


if __name__ == "__main__":
    main()
