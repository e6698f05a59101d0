"""Benchmarks tell a user's mistake in one line, as the tasks do."""

import runpy
import sys
from pathlib import Path

import plain_training
import pytest
import torch
from runs import train

from sdfhub.composition import one_line
from sdfhub.errors import SdfhubError
from tests.test_training import batches
from tests.tiny import build_autodecoder, composed

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks"
MISTAKES = {
    "evaluation.py --space nowhere": ["not a run's folder", "nowhere"],
    "evaluation.py --judged 1": ["argument --judged: '1': must be a whole number of at least 2"],
    "accuracy.py --seeds 0": ["argument --seeds"],
    "plain_training.py -m seed=0,1": ["-m: this makes one training"],
    "training.py data.shapes=x": ["data.shapes=x", "--shapes and --samples"],
    "training.py encoding=hash": ["encoding=hash", "names say"],
    "training.py activation.beta=4": ["activation.beta=4", "names say"],
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
    with pytest.raises(SdfhubError) as refused:
        train("refused", "category=chair")
    assert one_line(refused.value).count("did you mean 'chairs'?") == 1


@pytest.mark.parametrize(
    "experiment", ["deepsdf", "fft_hosc", "fft_siren_no_normals", "hash_siren", "fft_wire"]
)
def test_a_step_is_that_of_the_plain_training(experiment, several):
    """What accuracy.py compares is the same objective: only how it is computed differs."""
    config = composed(f"experiment={experiment}", "decoder.dropout=0", "computing.points_at_once=70")
    torch.manual_seed(0)
    model, batch = build_autodecoder(config, rows=5), batches(per_step=5)[0]
    have, want = (
        (loss, *parts.values(), *torch.autograd.grad(loss, list(model.parameters())))
        for loss, parts in (
            model.objective(batch, progress=0.5),
            plain_training.objective(model, batch, progress=0.5),
        )
    )
    for one, other in zip(have, want, strict=True):
        assert (one - other).norm() <= 1e-4 * other.norm() + 1e-9  # of DeepSDF's, one is a rounding error


def test_a_plain_training_says_what_it_is_not_written_for():
    model = build_autodecoder(composed("conditioning=film"), rows=5, steps=10)
    with pytest.raises(SdfhubError, match="conditioning=concat"):
        plain_training.objective(model, batches(per_step=5)[0], progress=0.5)
