"""Commands in processes of their own, forked from one that has imported all: a start takes seconds."""

import multiprocessing
import os
import runpy
import sys
import tempfile
from itertools import count
from pathlib import Path

ROOT = Path(__file__).parents[1]
SERVER = multiprocessing.get_context("forkserver")
SERVER.set_forkserver_preload(["sdfhub.tasks.train", "sdfhub.tasks.evaluate", "sdfhub.tasks.report"])
OUTPUTS = tempfile.TemporaryDirectory(prefix="sdfhub-")
NUMBERS = count()


def _run(words: list[str], environment: dict[str, str], output: Path) -> None:
    """In the process of a command: its words, environment and output, then what a user starts."""
    with output.open("wb") as file:
        for stream in (sys.stdout, sys.stderr):
            os.dup2(file.fileno(), stream.fileno())
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(ROOT)
    sys.argv = words
    runpy.run_path(words[0], run_name="__main__")


class Command:
    """`python train.py WORDS` as a process of its own; both of its streams are one text.

    Attributes:
        process: with `pid`, `kill()` and `exitcode`, which is None while it runs.
    """

    def __init__(self, *words: str, **environment: str):
        variables = os.environ | {"OMP_NUM_THREADS": "1"} | environment
        variables.pop("HYDRA_FULL_ERROR", None)
        self._output = Path(OUTPUTS.name) / str(next(NUMBERS))
        arguments = ([str(ROOT / "train.py"), *words], variables, self._output)
        self.process = SERVER.Process(target=_run, args=arguments)
        self.process.start()

    def output(self, status: int | None = 0, timeout: float = 280) -> str:
        """What it printed until its end, which has to come in time with an exit status (None: any)."""
        self.process.join(timeout)
        printed = self._output.read_text()
        assert self.process.exitcode is not None, f"still running: {printed[-2000:]}"
        assert status is None or self.process.exitcode == status, printed[-4000:]
        return printed
