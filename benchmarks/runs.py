"""What the benchmarks share: trainings as a user runs them, and one line for a user's mistake."""

import argparse
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException

from sdfhub.errors import SdfhubError
from sdfhub.locks import locked
from sdfhub.tasks.wording import one_line

ROOT = Path(__file__).resolve().parents[1]


def train(name: str, *overrides: str, script: str = "train.py") -> dict:
    """The content of `metrics.json` of one run under outputs/benchmarks/<name>; its output goes to stderr.

    Waits while another benchmark trains there.

    Args:
        name: of the run's folder.
        overrides: as on a command line.
        script: that trains, relative to the repository's root.

    Raises:
        SdfhubError: the run failed; the message is its own last line.
    """
    folder = ROOT / "outputs" / "benchmarks" / name
    command = [
        sys.executable,
        script,
        *overrides,
        f"hydra.run.dir={folder}",
        "trainer.enable_progress_bar=false",
    ]
    folder.parent.mkdir(parents=True, exist_ok=True)
    with locked(folder.parent / f"{name}.lock"):
        shutil.rmtree(folder, ignore_errors=True)  # what an earlier state of the code left is no answer
        done = subprocess.run(command, cwd=ROOT, stdout=sys.stderr, stderr=subprocess.PIPE, text=True)
        if done.returncode:
            last = (done.stderr.strip().splitlines() or ["no message"])[-1]
            raise SdfhubError(last.removeprefix("sdfhub: error: "))
        return json.loads((folder / "metrics.json").read_text())


def run_benchmark(main: Callable[[], None]) -> None:
    """Runs a benchmark; a user's mistake is one line on stderr and exit status 2, as with every task."""
    try:
        main()
    except (SdfhubError, HydraException, OmegaConfBaseException, OSError) as error:
        print(f"{Path(sys.argv[0]).name}: error: {one_line(error)}", file=sys.stderr)
        sys.exit(2)


def at_least(least: int) -> Callable[[str], int]:
    """What argparse takes as the `type` of a whole number that is not below `least`."""

    def number(text: str) -> int:
        if not re.fullmatch(r"-?\d+", text) or int(text) < least:
            raise argparse.ArgumentTypeError(f"{text!r}: must be a whole number of at least {least}")
        return int(text)

    return number
