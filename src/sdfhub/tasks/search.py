"""What a search for settings asks of its trainings, and how many it may still run."""

import os
from statistics import geometric_mean, mean, median
from typing import Any

from sdfhub.report.results import NOISE, ROLES, ShapeScore


def objective(metrics: dict[str, Any]) -> float | None:
    """What a search lowers: the geometric mean of what a table prints, mean and median excess by role.

    A factor counts alike in each; as a sum, held-out shapes, many times further off, would be all. Medians
    alone would not see the crumb that floats beside one shape of eight.

    Args:
        metrics: what `metrics.json` of a run holds.

    Returns:
        Squared units of the normalised frame, units where distances are judged for want of meshes; None where
        nothing was judged, such as after a failure.
    """
    judged = [metrics[role]["shapes"] for role in ROLES if metrics.get(role, {}).get("shapes")]
    errors = [[_error(row) for row in rows] for rows in judged]
    printed = [statistic(values) for values in errors for statistic in (mean, median)]
    return geometric_mean(max(value, NOISE) for value in printed) if printed else None


def _error(row: dict[str, Any]) -> float:
    """A shape's excess; the error of its distances where its source holds no meshes."""
    return row["sdf_error"] if "sdf_error" in row else ShapeScore.model_validate(row).excess


def trials_left(total: int, storage: str, study: str) -> int:
    """How many of a search's trainings are still to come: the same command goes on, it does not begin again.

    Args:
        total: trainings of the whole search.
        storage: URL of the study's database.
        study: its name there.
    """
    return max(0, int(total) - trials_done(storage, study))


def trials_done(storage: str, study: str) -> int:
    """How many of a search's trainings have ended, well or not."""
    os.environ.setdefault("SQLALCHEMY_SILENCE_UBER_WARNING", "1")  # of a version that the plugin is bound to
    import optuna  # an extra, and slow to import

    try:
        trials = optuna.load_study(study_name=study, storage=storage).trials
    except KeyError:  # no such study yet
        return 0
    return sum(trial.state.is_finished() for trial in trials)
