"""Every setting refuses what it cannot be, by name, and before a file is written or a shape prepared."""

import copy
import random
import sys
from pathlib import Path
from unittest.mock import patch

import pytest
from lightning.pytorch import Trainer

from benchmarks.overrides import Started, answer, keys_and_groups, random_override, shelf, started
from sdfhub.data.store import store as stores
from sdfhub.errors import SdfhubError
from sdfhub.settings import flat
from sdfhub.tasks import train as train_task
from tests.test_config import composed

CONFIG = composed("data.shapes=4", "data.source.count=20")
FREE = (
    "activation.",
    "category.",
    "encoding.",
    "data.source.categories.",
    "normals.",
    "output_root",
    "scale.",
)
"""What other keys are filled from, or another source reads."""
CLASSES = ("_target_", "_partial_")


def start(config: dict, folder: Path) -> None:
    """The start of a training, without its shapes and its steps."""
    with patch.object(stores, "prepare", shelf), patch.object(Trainer, "fit", started):
        train_task.train(config, folder)


def with_value(key: str, value) -> dict:
    config = node = copy.deepcopy(CONFIG)
    *path, last = key.split(".")
    for part in path:
        node = node[part]
    node[last] = value
    return config


KEYS = [
    key for key in flat(CONFIG) if not key.startswith(FREE) and not key.endswith(("_target_", "_partial_"))
]
NUMBERS = [key for key in KEYS if isinstance(flat(CONFIG)[key], float)]
COUNTS = [
    key
    for key in KEYS
    if type(flat(CONFIG)[key]) is int and not key.endswith("max_epochs") and "trainer" not in key
]


def test_the_config_as_it_is_starts(tmp_path):
    with pytest.raises(Started):
        start(copy.deepcopy(CONFIG), tmp_path)


@pytest.mark.parametrize("key", KEYS)
def test_a_setting_of_the_wrong_type_is_named(key, tmp_path):
    with pytest.raises(SdfhubError, match=key.rpartition(".")[2]) as caught:
        start(with_value(key, {"wrong": 1}), tmp_path)
    assert "\n" not in str(caught.value) and not list(tmp_path.rglob("*"))


@pytest.mark.parametrize("key", NUMBERS)
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_number_that_is_none_is_named(key, value, tmp_path):
    with pytest.raises(SdfhubError, match=key.rpartition(".")[2]):
        start(with_value(key, value), tmp_path)


@pytest.mark.parametrize("key", COUNTS)
def test_a_negative_count_is_named(key, tmp_path):
    with pytest.raises(SdfhubError, match=key.rpartition(".")[2]):
        start(with_value(key, -3), tmp_path)


@pytest.mark.parametrize("key", COUNTS)
def test_a_count_with_a_point_is_the_same_count(key, tmp_path):
    with pytest.raises(Started):
        start(with_value(key, float(flat(CONFIG)[key])), tmp_path)


def test_a_seed_beyond_what_generators_take_is_named(tmp_path):
    with pytest.raises(SdfhubError, match="seed"):
        start(with_value("seed", 2**31), tmp_path)


@pytest.mark.parametrize(
    ("word", "reply"),
    [
        ("~callbacks", "callbacks: is needed"),
        *((f"~{group}", f"{group}: is needed") for group in ("trainer", "data", "fit", "loss", "category")),
        *((f"~{group}", "are needed") for group in ("activation", "encoding", "decoder", "scale")),
        ("~data.held_out", "data.held_out: is needed"),
        ("+checkpoint.save_top_k=3", "checkpoint.save_top_k: no such setting"),
        ("trainer.max_steps=10", "write +trainer.max_steps="),
    ],
)
def test_what_is_left_out_or_unknown_is_named(word, reply, tmp_path):
    verdict, told = answer([word], tmp_path)
    assert verdict == "refused" and reply in told, (verdict, told)


@pytest.mark.parametrize("value", ["abc", None, 1.5, 0])
def test_a_limit_of_steps_that_is_none_is_named(value, tmp_path):
    config = copy.deepcopy(CONFIG)
    config["trainer"]["max_steps"] = value
    with pytest.raises(SdfhubError, match=r"trainer\.max_steps"):
        start(config, tmp_path)


def test_a_class_that_takes_no_settings_is_refused(tmp_path):
    with pytest.raises(SdfhubError, match=r"data\.loader\._target_"):
        start(with_value("data.loader._target_", "sdfhub.errors.SdfhubError"), tmp_path)


def test_a_misspelt_command_leaves_no_file_and_no_folder_of_a_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["train.py", "decoder.width=0", "hydra.run.dir=runs/first"])
    with pytest.raises(SystemExit):
        train_task.main()
    assert not list(tmp_path.iterdir())


REFUSED = ["seed=abc", "data=folder", "+foo=3", "data.store='${nowhere}'"]


@pytest.mark.parametrize("word", REFUSED)
def test_a_refused_run_leaves_no_folder_and_takes_none_away(word, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    mine = ["mine", "runs", "runs/empty", "runs/full", "runs/full/a"]
    for name in mine[1:4]:
        Path(name).mkdir()
    for name in ("mine", "runs/full/a"):
        Path(name).touch()
    for place in ([], *([f"hydra.run.dir={folder}"] for folder in ("runs/empty", "runs/full", "runs/x/y"))):
        monkeypatch.setattr(sys, "argv", ["train.py", word, *place])
        with pytest.raises(SystemExit) as stop:
            train_task.main()
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert stop.value.code == 2 and line.startswith("sdfhub: error: ")
        assert sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")) == mine


@pytest.mark.parametrize(
    "word",
    [
        "hydra/launcher=joblib",
        "hydra/launcher=submitit_slurm",
        "hydra/sweeper=basic",
        "hydra.sweeper.params=null",
    ],
)
def test_what_only_a_multirun_reads_is_refused_without_one(word, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["train.py", word])
    with (
        patch.object(train_task, "train", lambda *_: pytest.fail("trained")),
        pytest.raises(SystemExit) as stop,
    ):
        train_task.main()
    assert capsys.readouterr().err.strip() == f"sdfhub: error: {word}: needs -m"
    assert stop.value.code == 2 and not list(tmp_path.iterdir())


def check_random(count: int, seed: int, folder: Path) -> None:
    keys, groups = keys_and_groups()
    chance = random.Random(seed)
    for number in range(count):
        words = random_override(chance, keys, groups)
        verdict, told = answer(words, folder / str(number))
        assert verdict in ("started", "refused"), f"{words}: {told}"


@pytest.mark.slow
def test_a_thousand_random_overrides_end_without_a_traceback(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    check_random(1000, 0, tmp_path)
