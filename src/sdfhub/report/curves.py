"""Training curves, from the event files that every run keeps for TensorBoard."""

from pathlib import Path

from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sdfhub.data.workers import stream_in_processes, workers_worth

KEEP = {"scalars": 0, "images": 1, "audio": 1, "histograms": 1, "tensors": 1}
"""Of each tag; 0 keeps all. Pictures and meshes are in the same files and not wanted."""

A_WORKERS_WORTH = 16
"""Runs for which it pays to start a process that reads them."""


def curves_of(runs: list[Path]) -> dict[Path, list[tuple[int, float]]]:
    """The `curve` of each run, read in as many processes as it is worth: their files are parsed in Python."""
    workers = workers_worth(len(runs), A_WORKERS_WORTH)
    return dict(zip(runs, stream_in_processes(curve, runs, workers), strict=True))


def curve(run: Path, tag: str = "loss/sdf", points: int = 240) -> list[tuple[int, float]]:
    """A logged value by step, thinned out; [] where a run has none that can be read.

    Args:
        run: a run's folder.
        tag: of the value.
        points: how many to keep at most, the last one among them.
    """
    events = EventAccumulator(str(run / "tensorboard"), size_guidance=KEEP)
    try:
        by_step = {event.step: float(event.value) for event in events.Reload().Scalars(tag)}
    except Exception:  # no such folder or tag, or a file that a kill cut off: a picture less, no error
        return []
    found = sorted(by_step.items())
    stride = max(1, -(-len(found) // points))
    return found[::-1][::stride][::-1]
