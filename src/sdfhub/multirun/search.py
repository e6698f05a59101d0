"""What a search for settings asks of its trainings, and how many of them are left."""

import os
from math import inf
from statistics import geometric_mean, mean, median
from typing import Any

from sdfhub.report.results import ROLES, ShapeScore

NOISE = 1e-6  # excess that 30,000 points a side cannot tell from none, normalised units squared


def objective(metrics: dict[str, Any]) -> float:
    """What a search lowers: the geometric mean of mean and median excess CD of both roles, in `metrics.json`.

    A median alone would not see one broken shape. Without meshes: error of distances. Failure: infinite.
    """
    judged = [metrics[role]["shapes"] for role in ROLES if metrics.get(role, {}).get("shapes")]
    errors = [
        [row["sdf_error"] if "sdf_error" in row else ShapeScore.model_validate(row).excess for row in rows]
        for rows in judged
    ]
    printed = [max(statistic(values), NOISE) for values in errors for statistic in (mean, median)]
    return geometric_mean(printed) if printed else inf


def trials_left(total: int, storage: str, study: str) -> int:
    """How many of `total` trainings are still to come, so that the same command continues a search."""
    return max(0, int(total) - trials_done(storage, study))


def trials_done(storage: str, study: str) -> int:
    """How many trainings of the study at the URL `storage` have ended, well or not."""
    os.environ.setdefault("SQLALCHEMY_SILENCE_UBER_WARNING", "1")  # about the version that the plugin needs
    import optuna  # an extra, and slow to import

    try:
        trials = optuna.load_study(study_name=study, storage=storage).trials
    except KeyError:  # no such study yet
        return 0
    return sum(trial.state.is_finished() for trial in trials)
