"""Items mapped over worker processes; light imports, since a worker repeats them."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from sdfhub.data.workers import SAFE_PATH, THREADS, Crashed, map_in_processes


class DiesElsewhere:
    """A square, or the end of the process unless it is the one that it was made in."""

    def __init__(self):
        self.home = os.getpid()

    def __call__(self, number: int) -> int:
        if number == 6 and os.getpid() != self.home:
            os._exit(1)
        return number**2


def variable(name: str) -> str | None:
    return os.environ.get(name)


@pytest.mark.parametrize("workers", [1, 2])
def test_items_are_taken_while_others_are_computed(workers):
    taken = []
    items = (taken.append(number) or number for number in range(10))
    results = map_in_processes(abs, items, workers)
    next(results)
    assert len(taken) <= 5
    assert len(list(results)) == 9


def test_the_item_on_which_a_worker_dies_is_named_and_the_others_go_on():
    results = dict(map_in_processes(DiesElsewhere(), iter(range(12)), workers=2))
    assert isinstance(results.pop(6), Crashed)
    assert results == {number: number**2 for number in range(12) if number != 6}


def test_workers_are_single_threaded_and_the_environment_here_stays(monkeypatch):
    monkeypatch.setenv(THREADS[0], "7")
    before = dict(os.environ)
    results = dict(map_in_processes(variable, [*THREADS, SAFE_PATH], workers=2))
    assert set(results.values()) == {"1"} and dict(os.environ) == before


SCRIPT = """
import os, sys, time
from sdfhub.data.workers import map_in_processes
from tests.test_workers import DiesElsewhere
print("ran", flush=True)
for name in ("random", "loky", "struct"):  # in the current folder, not to be imported
    open(name + ".py", "w").write("raise SystemExit('imported ' + __file__)")
def slow(number):
    os.write(1, f"started {os.getpid()}\\n".encode())  # at once: two workers write
    time.sleep(number)
    return number
print(sorted(result for _, result in map_in_processes(slow, [float(word) for word in sys.argv[1:]], 2)))
"""


def started(folder: Path, *seconds: str) -> subprocess.Popen:
    """A script without `if __name__ == "__main__"` that maps a function of its own."""
    (folder / "scripts").mkdir()
    script = folder / "scripts" / "mine.py"
    script.write_text(SCRIPT)
    root = Path(__file__).parents[1]
    environment = os.environ | {"PYTHONPATH": f"{root / 'src'}:{root}"}
    return subprocess.Popen(
        [sys.executable, str(script), *seconds],
        cwd=folder,
        env=environment,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )


def test_a_script_without_a_guard_runs_once_and_nothing_of_its_folder_is_imported(tmp_path):
    output, _ = started(tmp_path, "0", "0.1", "0.2").communicate(timeout=60)
    assert output.count("ran") == 1 and output.endswith("[0.0, 0.1, 0.2]\n") and "imported" not in output


def ended(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


def test_workers_end_with_the_process_that_they_work_for(tmp_path):
    for number in (signal.SIGKILL, signal.SIGINT):
        folder = tmp_path / number.name
        folder.mkdir()
        with started(folder, "60", "60") as run:
            assert run.stdout.readline() == "ran\n"
            workers = [int(run.stdout.readline().split()[1]) for _ in range(2)]
            assert not any(ended(pid) for pid in workers)
            run.send_signal(number)
            for _ in range(300):
                if all(ended(pid) for pid in workers):
                    break
                time.sleep(0.1)
            assert all(ended(pid) for pid in workers)
