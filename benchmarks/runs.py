"""Runs train.py as a user would and reads what it wrote."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def train(name: str, *overrides: str) -> dict:
    """The content of `metrics.json` of one run under outputs/benchmarks/<name>; its output goes to stderr.

    Raises:
        RuntimeError: the run failed; the message is its own last line.
    """
    folder = ROOT / "outputs" / "benchmarks" / name
    shutil.rmtree(folder, ignore_errors=True)  # what an earlier state of the code left is no answer
    command = [
        sys.executable,
        "train.py",
        *overrides,
        f"hydra.run.dir={folder}",
        "trainer.enable_progress_bar=false",
    ]
    done = subprocess.run(command, cwd=ROOT, stdout=sys.stderr, stderr=subprocess.PIPE, text=True)
    if done.returncode:
        raise RuntimeError((done.stderr.strip().splitlines() or ["no message"])[-1])
    return json.loads((folder / "metrics.json").read_text())


def row(name: str, metrics: dict, role: str = "known") -> str:
    """A Markdown line for the shapes of a role: CD, floor and excess times 10^3, failures, size, seconds."""
    summary, training = metrics[role]["summary"], metrics["training"]
    if summary["cd"]["mean"] is None:
        cells = ["no surface"] + [""] * 4
    else:
        pairs = [
            ("cd", "mean"),
            ("cd", "median"),
            ("floor", "mean"),
            ("excess", "mean"),
            ("excess", "median"),
        ]
        cells = [f"{summary[key][statistic] * 1e3:.4f}" for key, statistic in pairs]
    counts = [
        f"{summary['failed']}/{summary['shapes']}",
        f"{training['parameters']:,}",
        f"{training['seconds']:.0f}",
    ]
    return f"| {name} | " + " | ".join(cells + counts) + " |"


HEAD = (
    "| run | CD mean | CD median | floor | excess mean | excess median | no surface | parameters "
    "| seconds |\n"
    "| --- | --- | --- | --- | --- | --- | --- | --- | --- |"
)
