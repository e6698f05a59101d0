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
