"""What a user's own command line names is theirs: classes, callbacks, loggers, Trainer arguments, folders."""

import logging
import sys
from pathlib import Path

import pytest
import torch
import yaml

import sdfhub
from sdfhub.errors import SdfhubError
from sdfhub.model.autodecoder import AutoDecoder
from tests.tiny import TINY, run_command, scores, train_tiny

PACKAGE = """
from dataclasses import dataclass

import lightning as L
import torch

import sdfhub


class Snake(sdfhub.Activation):
    def __init__(self, a: float, first: bool = False):
        super().__init__(first)
        self.a = a

    def forward(self, x):
        return x + torch.sin(self.a * x) ** 2 / self.a


class Radius(sdfhub.Encoding):
    features = 4

    def forward(self, points):
        return torch.cat([points, points.square().sum(-1, keepdim=True)], dim=-1)


@dataclass
class Linear:
    final: float = 0.0

    def __call__(self, progress):
        return 1 + (self.final - 1) * progress


class Counter(L.Callback):
    steps = 0

    def on_train_batch_end(self, *_):
        Counter.steps += 1
"""


@pytest.fixture
def mypkg(tmp_path, monkeypatch) -> Path:
    """A package of the user's own on the Python path."""
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "mypkg.py").write_text(PACKAGE)
    monkeypatch.syspath_prepend(tmp_path / "own")
    yield tmp_path / "own"
    sys.modules.pop("mypkg", None)


OWN = ["activation._target_=mypkg.Snake", "+activation.a=2", "encoding._target_=mypkg.Radius"]


def test_an_activation_and_an_encoding_of_ones_own_train_and_are_judged_and_exported_by_trust(
    mypkg, monkeypatch, tmp_path, capsys
):
    run = train_tiny(monkeypatch, tmp_path / "run", "callbacks=none", *OWN)
    assert len(scores(run)) == 2
    space = sdfhub.load(run, trust="mypkg")
    assert type(space.decoder.activations[0]).__name__ == "Snake" and space.decoder.encoding.features == 4
    with pytest.raises(SdfhubError, match=r"mypkg\.\w+.*trust=mypkg"):
        sdfhub.load(run)
    capsys.readouterr()
    small = ["evaluate.resolution=24", "evaluate.points=500", "fit.samples=500"]
    assert run_command(monkeypatch, str(run), *small, task="evaluate") == 2
    assert "trust=mypkg" in capsys.readouterr().err
    assert run_command(monkeypatch, str(run), *small, "trust=mypkg", task="evaluate") == 0
    assert run_command(monkeypatch, str(run), "safetensors", "trust=mypkg", task="export") == 0
    with pytest.raises(SdfhubError, match="trust=mypkg"):
        sdfhub.load(run / "export" / "model.safetensors")
    assert sdfhub.load(run / "export" / "model.safetensors", trust=["mypkg"]).ids == space.ids


@pytest.mark.parametrize(
    "words",
    [
        ["activation._target_=torch.nn.GELU", "+trainer.gradient_clip_val=0.5", "logger=csv"],
        ["optim.schedule._target_=mypkg.Linear", "optim.schedule.final=0.1", "+trainer.logger=false"],
        ["optim._target_=torch.optim.AdamW", "+optim.weight_decay=0.01", "logger=none"],
        ["optimizer=muon", "+callbacks.mine._target_=mypkg.Counter"],
        ["+callbacks.swa={_target_: lightning.pytorch.callbacks.StochasticWeightAveraging, swa_lrs: 1e-3}"],
        ["callbacks=ema", "~callbacks.mesh", "callbacks.slices=null", "~callbacks.progress_bar"],
        ["+trainer.fast_dev_run=true", "+trainer.detect_anomaly=true"],
        ["+trainer.overfit_batches=1"],
        ["+trainer.limit_train_batches=2", "+trainer.limit_val_batches=0"],
        ["+trainer.accumulate_grad_batches=2", "+trainer.max_steps=4"],
        ["logger=many"],
        ["paths.data='${oc.env:HOME}/sdfhub-data'", "debug=fast_dev_run"],
        ["debug=limit"],
    ],
    ids=lambda words: words[-1].removeprefix("+")[:40],
)
def test_what_users_of_lightning_and_hydra_do_on_the_first_day(words, mypkg, monkeypatch, tmp_path):
    watched = [word for word in words if word.startswith(("callbacks=", "debug", "logger=many"))]
    bare = [] if watched else ["callbacks=none"]  # most of a tiny training's time
    train_tiny(monkeypatch, tmp_path / "run", *bare, *words)
    if "+callbacks.mine._target_=mypkg.Counter" in words:
        assert sys.modules["mypkg"].Counter.steps == 10


def test_a_profiler_prints_and_the_log_of_a_run_keeps_what_it_said(monkeypatch, tmp_path):
    run = train_tiny(monkeypatch, tmp_path / "run", "callbacks=none", "+trainer.profiler=simple")
    text = (run / "train.log").read_text()
    assert "run_training_epoch" in text and "CD x10^3" in text
    assert (run / ".hydra" / "overrides.yaml").is_file()
    logging.getLogger().handlers.clear()


def test_a_config_folder_of_ones_own_adds_choices(mypkg, monkeypatch, tmp_path):
    (tmp_path / "conf" / "activation").mkdir(parents=True)
    snake = {"_target_": "mypkg.Snake", "_partial_": True, "a": 3}
    (tmp_path / "conf" / "activation" / "snake.yaml").write_text(yaml.safe_dump(snake))
    (tmp_path / "conf" / "experiment").mkdir()
    (tmp_path / "conf" / "experiment" / "mine.yaml").write_text(
        "# @package _global_\ndefaults:\n  - override /activation: snake\nseed: 7\n"
    )
    words = ["callbacks=none", "experiment=mine", "--config-dir", str(tmp_path / "conf")]
    run = train_tiny(monkeypatch, tmp_path / "run", *words)
    config = yaml.safe_load((run / "config.yaml").read_text())
    assert (config["activation"]["a"], config["seed"]) == (3, 7)
    searchpath = f"hydra.searchpath=[file://{tmp_path / 'conf'}]"
    train_tiny(monkeypatch, tmp_path / "second", "callbacks=none", searchpath, "activation=snake")


def test_load_from_checkpoint_gives_the_trained_model_from_plain_data(monkeypatch, tmp_path):
    run = train_tiny(monkeypatch, tmp_path / "run", "callbacks=none")
    path = run / "checkpoints" / "last.ckpt"
    model = AutoDecoder.load_from_checkpoint(path)
    space = sdfhub.load(run)
    points = torch.rand(1, 50, 3)
    assert torch.equal(model.eval()(points, torch.tensor([0]))[0], space.sdf(points[0], 0))
    content = torch.load(path, weights_only=True)
    assert content["hyper_parameters"]["decoder"]["_target_"] == "sdfhub.model.decoder.Decoder"
    assert model.hparams["decoder"] == content["hyper_parameters"]["decoder"]


def test_a_run_is_judged_from_anywhere(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    run = tmp_path / "run"
    words = [word for word in TINY if not word.startswith("callbacks.")]
    assert run_command(monkeypatch, *words, "callbacks=none", "hydra.run.dir=run", "data.store=my/store") == 0
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    small = ["evaluate.resolution=24", "evaluate.points=500", "fit.samples=500"]
    assert run_command(monkeypatch, str(run), *small, task="evaluate") == 0
    assert not list((tmp_path / "elsewhere").rglob("*.safetensors")), "the store of the run was found"


def test_the_version_is_told(monkeypatch, capsys):
    assert run_command(monkeypatch, task="--version") == 0
    assert capsys.readouterr().out.split() == ["sdfhub", sdfhub.__version__]
