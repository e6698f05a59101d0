"""What the benchmarks share: trainings as a user runs them, and Markdown tables."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

from sdfhub.whole_file import locked

ROOT = Path(__file__).resolve().parents[1]
OUTPUTS = ROOT / "outputs" / "benchmarks"


def train(name: str, *overrides: str, script: str = "train.py") -> dict:
    """The content of `metrics.json` of one run under outputs/benchmarks/<name>; its output goes to stderr.

    Waits while another benchmark trains there.

    Args:
        name: of the run's folder.
        overrides: as on a command line.
        script: that trains, relative to the repository's root.
    """
    folder = OUTPUTS / name
    words = [f"hydra.run.dir={folder}", "trainer.enable_progress_bar=false", "++trainer.limit_val_batches=0"]
    folder.parent.mkdir(parents=True, exist_ok=True)
    with locked(folder.parent / f"{name}.lock"):
        shutil.rmtree(folder, ignore_errors=True)  # what an earlier state of the code left is no answer
        subprocess.run([sys.executable, script, *overrides, *words], cwd=ROOT, stdout=sys.stderr, check=True)
        return json.loads((folder / "metrics.json").read_text())


def head(columns: str) -> None:
    """Prints the head of a Markdown table.

    Args:
        columns: their titles, separated by ` | `.
    """
    print(f"\n| {columns} |\n|{' --- |' * len(columns.split('|'))}", flush=True)


def row(*cells: object) -> None:
    """Prints a row of a Markdown table."""
    print(f"| {' | '.join(map(str, cells))} |", flush=True)
