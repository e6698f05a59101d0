"""A table of the paper is one command: its cells compose, go on where they stopped, and fail alone."""

import json
import re
import sys
from functools import cache
from pathlib import Path

import pytest
import torch
import yaml
from hydra import initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.types import RunMode

from sdfhub.callbacks.showing import TrainingRecord
from sdfhub.errors import SdfhubError
from sdfhub.report.plan import PlannedCell
from sdfhub.report.results import Cell, read_sweep
from sdfhub.report.rows import group_cells
from sdfhub.settings import flat, settings_digest
from sdfhub.tasks import train as train_task
from sdfhub.tasks.app import register_resolvers
from sdfhub.tasks.build import build, plain
from sdfhub.tasks.cells import finished
from sdfhub.tasks.evaluate import build_evaluation
from sdfhub.tasks.run import build_autodecoder
from sdfhub.tasks.sweep import as_planned, jobs
from tests.sweep_folders import score
from tests.test_config import CHOICES, CONF, composed

SWEEPS = [choice for group, choice in CHOICES if group == "sweeps"]


def of_multirun(function, *overrides: str):
    """What `function` makes of the config of `train.py -m ...`."""
    register_resolvers()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        hydra = GlobalHydra.instance().hydra
        config = hydra.compose_config("config", list(overrides), run_mode=RunMode.MULTIRUN)
        return function(config)


@cache
def cells(*overrides: str) -> list[tuple[PlannedCell, dict]]:
    """The cells of a multirun and their configs."""

    def composed_cells(config):
        loader = GlobalHydra.instance().config_loader()
        configs = [loader.load_sweep_config(config, job) for job in jobs(config)]
        return [(as_planned(one), plain(one)) for one in configs]

    return of_multirun(composed_cells, *overrides)


def test_issue_sweeps_are_all_there():
    wanted = {"table_small", "table_large", "table_params", "encodings", "normals", "activations", "smoke"}
    assert wanted <= set(SWEEPS)


@pytest.mark.parametrize("sweep", SWEEPS)
def test_every_cell_of_a_sweep_composes_and_builds(sweep):
    found = cells(f"sweeps={sweep}")
    assert len(found) >= 3
    for _, config in found:
        with torch.device("meta"):  # sizes without the cost of initialisation
            build_autodecoder(config, rows=2)
        build_evaluation(config["evaluate"], config["loss"])
        build(config["data"]["loader"], "data.loader")
        build(config["optim"], "optim", within="sdfhub.model")
    assert len({planned.folder for planned, _ in found}) == len(found), "two cells never share a folder"


def labels(sweep: str) -> list[str]:
    missing = [Cell(plan, Path(plan.folder), "missing", "", None) for plan, _ in cells(f"sweeps={sweep}")]
    return [row.label for group in group_cells(missing) for row in group.rows]


def test_the_tables_have_the_papers_rows_and_their_rivals():
    methods = ("SIREN", "FFT/SIREN", "FFT/HOSC", "HASH/SIREN", "HASH/HOSC")
    wanted = ["DeepSDF"] + [f"{m}{end}" for m in methods for end in (" + normals", ", no normals")]
    assert labels("table_small") == wanted
    assert labels("table_params") == ["DeepSDF", "FFT/SIREN + normals", "FFT/HOSC + normals"]
    assert labels("normals")[:2] == ["DeepSDF + normals", "DeepSDF"]


def test_scale_says_how_many_shapes_a_table_has():
    for sweep, scale, shapes in (
        ("table_small", "demo", 8),
        ("table_small", "paper", 100),
        ("table_large", "paper", 1000),
    ):
        config = composed(f"sweeps={sweep}", f"scale={scale}")
        assert config["data"]["shapes"] == shapes
    assert composed("sweeps=table_large")["data"]["shapes"] == 200
    assert composed("sweeps=table_small", "scale=paper", "data.shapes=7")["data"]["shapes"] == 7


def test_seeds_categories_and_data_multiply_a_sweep():
    found = of_multirun(jobs, "sweeps=smoke", "seed=0,1,2", "category=chairs,lamps", "data=open")
    assert len(found) == 2 * 3 * 2
    for words in ("seed=2", "category=lamps", "experiment=deepsdf"):
        assert sum(words in job for job in found) in (4, 6)
    assert all("data=open" in job for job in found)


def test_the_same_cell_has_the_same_folder_and_another_has_another():
    def folder(*overrides):
        ((planned, _),) = cells("sweeps=smoke", "experiment=deepsdf", "seed=0", *overrides)
        return planned.folder

    first = folder()
    assert folder("output_root=elsewhere", "data.workers=1", "trainer.accelerator=cpu") == first
    assert first in {planned.folder for planned, _ in cells("sweeps=smoke")}, "a seed said or left out"
    others = {folder(other) for other in ("scale=cpu", "loss.delta=0.2", "category=lamps")}
    assert len(others) == 3 and first not in others


def test_a_sweep_is_found_again_by_its_name_and_a_nameless_one_has_a_folder_of_its_own():
    def place(*overrides):
        return of_multirun(lambda config: config.hydra.sweep.dir, *overrides)

    assert place("sweeps=smoke", "seed=0,1") == place("sweeps=smoke") == "outputs/sweeps/smoke"
    assert place("activation=relu,siren") != place("activation=relu,siren")


def test_a_finished_cell_is_known_by_its_settings_alone():
    config = composed("seed=3")
    assert settings_digest(config) == settings_digest(composed("seed=3", "output_root=x", "callbacks=none"))
    for key in ("seed=4", "trainer.max_epochs=7", "activation.beta=3"):
        assert settings_digest(composed("seed=3", key)) != settings_digest(config)
    assert "loss.delta" in flat(config)


@pytest.mark.parametrize("key", ["data.source.root", "computing.matmul"])
def test_cells_of_other_data_or_products_are_other_cells(key):
    one, other = ({"data": {"source": {}}, "computing": {}} for _ in range(2))
    *path, last = key.split(".")
    for value, node in (("chairs", one), ("tables", other)):
        for part in path:
            node = node[part]
        node[last] = value
    assert settings_digest(one) != settings_digest(other)


class Trainer:
    """Stands in for training: notes its calls, writes scores, fails or is interrupted where told to."""

    def __init__(self):
        self.calls, self.fail, self.interrupt = [], None, None

    def __call__(self, config: dict, run: Path) -> dict:
        row = config["activation"]["_target_"].rpartition(".")[2], config["seed"]
        self.calls.append(row)
        (run / "config.yaml").write_text(yaml.safe_dump(config))
        (run / "split.json").write_text(json.dumps({"train": ["a"], "held_out": []}))
        if self.interrupt == row:
            raise KeyboardInterrupt
        if self.fail == row:
            raise SdfhubError("the loss is not finite at step 7")
        metrics = {"training": {"seconds": 1.0, "steps": 5, "parameters": 9}}
        metrics["known"] = {"summary": {}, "shapes": [score("a", 1e-3)]}
        (run / "metrics.json").write_text(json.dumps(metrics))
        return metrics


@pytest.fixture
def trainer(monkeypatch, tmp_path):
    """`train.py -m sweeps=smoke` in this process, without training."""
    stand_in = Trainer()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(train_task, "train", stand_in)
    monkeypatch.setattr(sys, "argv", ["train.py", "-m", "sweeps=smoke", "seed=0"])
    return stand_in


def status() -> int:
    try:
        train_task.main()
    except SystemExit as stop:
        return stop.code
    return 0


ALL = [("Relu", 0), ("Siren", 0)]


def test_an_interrupted_sweep_goes_on_with_what_is_missing_and_repeats_nothing(trainer, tmp_path, capsys):
    trainer.interrupt = ("Siren", 0)
    assert status() == 130
    assert trainer.calls == ALL
    sweep = tmp_path / "outputs" / "sweeps" / "smoke"
    assert [cell.state for cell in read_sweep(sweep)] == ["done", "missing"]
    trainer.calls, trainer.interrupt = [], None
    assert status() == 0
    assert trainer.calls == ALL[1:]
    assert "| DeepSDF " in capsys.readouterr().out


def test_groups_that_no_name_tells_are_settings_where_they_are_said(trainer, monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "argv", ["train.py", "-m", "sweeps=smoke", "seed=0", "conditioning=concat,film"])
    assert status() == 0
    (group,) = group_cells(read_sweep(tmp_path / "outputs" / "sweeps" / "smoke"))
    assert [row.label for row in group.rows] == [
        f"{method} (conditioning={choice})"
        for method in ("DeepSDF", "FFT/SIREN + normals")
        for choice in ("concat", "film")
    ]


def test_a_failing_cell_stops_no_other_and_is_tried_again(trainer, tmp_path, capsys):
    sweep = tmp_path / "outputs" / "sweeps" / "smoke"
    trainer.fail = ("Relu", 0)
    assert status() == 1
    assert trainer.calls == ALL
    told = capsys.readouterr()
    assert "the loss is not finite at step 7" in told.err and "Traceback" not in told.err
    assert re.search(r"\| DeepSDF, seed 0 +\| failed +\| the loss is not finite at step 7 +\|", told.out)
    assert "the loss is not finite at step 7" in (sweep / "report" / "report.html").read_text()
    trainer.calls, trainer.fail = [], None
    assert status() == 0
    assert trainer.calls == ALL[:1]
    assert [cell.state for cell in read_sweep(sweep)] == ["done"] * 2


def test_a_failure_written_after_the_scores_is_forgotten_when_they_are_found(trainer, tmp_path):
    assert status() == 0
    sweep = tmp_path / "outputs" / "sweeps" / "smoke"
    (read_sweep(sweep)[0].folder / "failed.json").write_text(json.dumps({"reason": "the disk was full"}))
    assert [cell.state for cell in read_sweep(sweep)] == ["failed", "done"]
    trainer.calls = []
    assert status() == 0 and trainer.calls == []
    assert [cell.state for cell in read_sweep(sweep)] == ["done", "done"]


def test_failed_cells_are_told_where_the_report_breaks(trainer, monkeypatch, capsys):
    def broken(*arguments):
        raise KeyError("a fault of the report's own")

    monkeypatch.setattr("sdfhub.tasks.report.write_report", broken)
    trainer.fail = ("Relu", 0)
    assert status() == 1
    told = capsys.readouterr().err
    assert "1 of 2 cells failed" in told and "no report" in told and "Traceback" not in told


@pytest.mark.parametrize("seeds", ["abc", "0,-1", "1.5"])
def test_a_seed_that_is_none_is_refused_before_any_cell(seeds, trainer, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["train.py", "-m", "sweeps=smoke", f"seed={seeds}"])
    assert status() == 2
    told = capsys.readouterr().err
    assert "seed=" in told and "Traceback" not in told and trainer.calls == []


def test_metrics_of_other_settings_or_broken_ones_do_not_count_as_finished(tmp_path):
    config = composed("seed=3")
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(config))
    (tmp_path / "split.json").write_text(json.dumps({"train": ["a"]}))
    assert finished(tmp_path, config) is None
    whole = {"training": {"seconds": 1.0, "steps": 5, "parameters": 9}}
    (tmp_path / "metrics.json").write_text(json.dumps(whole))
    assert finished(tmp_path, config) == whole
    assert finished(tmp_path, config | {"seed": 4}) is None
    for broken in ('{"known": ', "{}", "[1, 2]", '{"training": {"seconds": "x"}}'):
        (tmp_path / "metrics.json").write_text(broken)
        assert finished(tmp_path, config) is None, broken


def test_a_sweep_without_multirun_says_what_to_add(trainer, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["train.py", "sweeps=smoke"])
    assert status() == 2
    assert "add -m" in capsys.readouterr().err


def test_a_sweep_that_is_not_there_is_answered_with_those_that_are(trainer, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["train.py", "-m", "sweeps=table_smal"])
    assert status() == 2
    told = capsys.readouterr().err
    assert "table_small" in told and "Traceback" not in told


REFUSED = {
    "sweeps=smoke,table_small": "sweeps=smoke,table_small: takes one name",
    "+foo=3": "there is no group or key 'foo'",
    "+foo=3,4": "there is no group or key 'foo'",
    "~data.held_out": "data.held_out: is needed",
    "experiment=siren,sirenn": "did you mean 'siren'?",
    'hydra.sweeper.params.experiment="fft_siren,hosk"': "Could not find 'experiment/hosk' Available options",
}


@pytest.mark.parametrize("word", REFUSED)
def test_a_sweep_that_cannot_be_is_refused_in_one_line_before_a_folder(
    word, trainer, monkeypatch, capsys, tmp_path
):
    monkeypatch.setattr(sys, "argv", ["train.py", "-m", "sweeps=smoke", word])
    assert status() == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("sdfhub: error: ") and REFUSED[word] in line
    assert trainer.calls == [] and not list(tmp_path.iterdir())


def test_a_sweep_whose_folders_only_its_jobs_know_is_trained(trainer, monkeypatch, tmp_path):
    words = ["train.py", "-m", "sweeps=smoke", "seed=0", "hydra.sweep.subdir='${hydra.job.num}'"]
    monkeypatch.setattr(sys, "argv", words)
    assert status() == 0
    assert [path.parent.name for path in sorted(tmp_path.rglob("metrics.json"))] == ["0", "1"]


def test_seconds_and_losses_of_an_interrupted_training_count_when_it_goes_on():
    before, after = TrainingRecord(), TrainingRecord()
    before.load_state_dict({"seconds": 40.0, "first": [3.0] * 20, "last": [2.0] * 20})
    after.load_state_dict(before.state_dict())
    assert after.state_dict() == {"seconds": 40.0, "first": [3.0] * 20, "last": [2.0] * 20}
