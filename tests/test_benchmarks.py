"""Benchmarks tell a user's mistake in one line, as the tasks do."""

import runpy
import sys
from pathlib import Path

import pytest
from runs import train

from sdfhub.errors import SdfhubError

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks"
MISTAKES = {
    "evaluation.py --space nowhere": ["not a run's folder", "nowhere"],
    "evaluation.py --judged 1": ["argument --judged: '1': must be a whole number of at least 2"],
    "training.py data.shapes=x": ["data.shapes=x", "--shapes and --samples"],
    "training.py encoding=hash": ["encoding=hash", "names say"],
    "training.py loss=nonsense": ["nonsense", "paper"],
    "viewing.py nowhere": ["nowhere: there is no such run or file"],
    "viewing.py . many": ["'many': must be a whole number of at least 1"],
    "growth.py --steps 150": ["--steps 150: must be a multiple of 100"],
    "growth.py --rounds 0": ["argument --rounds"],
    "meshing.py --spaces boats": ["--spaces", "'boats'"],
    "mirrors.py nowhere": ["nowhere"],
}


@pytest.mark.parametrize("command", MISTAKES)
def test_a_mistake_is_one_line(command, monkeypatch, capsys, tmp_path):
    script, *words = command.split()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [str(FOLDER / script), *words])
    with pytest.raises(SystemExit) as stop:
        runpy.run_path(str(FOLDER / script), run_name="__main__")
    out, err = capsys.readouterr()
    assert stop.value.code == 2 and not out
    message = err.strip().splitlines()[-1]
    assert message.startswith(f"{script}: error: ")
    for word in MISTAKES[command]:
        assert word in message


def test_a_training_that_fails_tells_its_own_last_line():
    with pytest.raises(SdfhubError, match=r"^there is no group or key 'nonsense'"):
        train("refused", "scale=demo", "nonsense=1")
