"""How a sweep was made: its commands, how long it trained, versions and hardware."""

from collections import Counter
from importlib.metadata import PackageNotFoundError, version

from sdfhub.report.results import Cell
from sdfhub.report.rows import duration
from sdfhub.report.tables import Table


def origin_table(commands: list[str], cells: list[Cell]) -> Table:
    """The table that lets a reader repeat a sweep.

    Args:
        commands: that asked for the cells.
        cells: all of them.
    """
    trainings = [cell.scores.training for cell in cells if cell.scores]
    spent = duration(sum(training.seconds for training in trainings))
    rows = [["command", command] for command in commands]
    rows.append(["trainings", f"{len(trainings)} of {len(cells)} done, {spent} in all"])
    told = Counter(", ".join(f"{k} {v}" for k, v in one.made_with.items()) for one in trainings)
    rows += [[f"{count} of them with", words or "not written down"] for words, count in told.items()]
    return Table("How it was made", ["what", "which"], rows, [])


def installed_version(package: str) -> str:
    """A package's version, or that it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:  # run from a folder without an installation
        return "(not installed)"
