"""A table of the paper is one command: its cells compose, go on where they stopped, and fail alone."""

import json
import re
from functools import cache
from pathlib import Path

import pytest
from hydra.types import RunMode

from sdfhub.multirun.sweep import finished, planned_cells
from sdfhub.report.results import Cell, PlannedCell, read_sweep
from sdfhub.report.rows import group_cells
from tests.stand_in_training import CONF, of_multirun, stand_in

SWEEPS = ["activations", "encodings", "normals", "smoke", "table_large", "table_params", "table_small"]


@cache
def cells(*overrides: str) -> list[PlannedCell]:
    return of_multirun(planned_cells, *overrides)


def test_the_sweeps_stand_at_the_top_level_and_are_a_group():
    assert sorted(path.stem for path in (CONF.parent / "sweeps").glob("*.yaml")) == SWEEPS
    assert sorted(path.stem for path in (CONF / "sweeps").glob("*.yaml")) == SWEEPS


@pytest.mark.parametrize("sweep", SWEEPS)
def test_two_cells_of_a_sweep_never_share_a_folder(sweep):
    planned = cells(f"sweeps={sweep}")
    assert len({cell.folder for cell in planned}) == len(planned) >= 3


def test_the_tables_have_the_papers_rows_and_their_rivals():
    def labels(sweep: str) -> list[str]:
        missing = [Cell(cell, Path(cell.folder), "missing") for cell in cells(f"sweeps={sweep}")]
        return [row.label for group in group_cells(missing) for row in group.rows]

    methods = ("SIREN", "FFT/SIREN", "FFT/HOSC", "HASH/SIREN", "HASH/HOSC")
    wanted = ["DeepSDF"] + [f"{m}{end}" for m in methods for end in (" + normals", ", no normals")]
    assert labels("table_small") == wanted
    assert labels("table_params") == ["DeepSDF", "FFT/SIREN + normals", "FFT/HOSC + normals"]


@pytest.mark.parametrize(
    ("words", "shapes"),
    [
        (("sweeps=table_small", "scale=paper"), 100),
        (("sweeps=table_large", "scale=paper"), 1000),
        (("sweeps=table_large",), 200),
        (("sweeps=table_small", "data.shapes=7"), 7),
    ],
)
def test_scale_says_how_many_shapes_a_table_has(words, shapes):
    assert of_multirun(lambda config: config.data.shapes, *words) == shapes


def test_seeds_categories_and_data_multiply_a_sweep():
    planned = cells("sweeps=smoke", "seed=0,1,2", "category=chairs,lamps", "data=open")
    assert len(planned) == 2 * 3 * 2 and {cell.seed for cell in planned} == {0, 1, 2}
    assert {cell.choices["category"] for cell in planned} == {"chairs", "lamps"}


def test_a_cells_folder_tells_every_setting_that_decides_its_result():
    def folder(*overrides: str) -> str:
        (cell,) = cells("sweeps=smoke", "experiment=deepsdf", "seed=0", *overrides)
        return cell.folder

    first = folder()
    assert first.startswith("procedural_chairs_deepsdf_") and "_seed-0_" in first
    assert first in {cell.folder for cell in cells("sweeps=smoke")}, "a seed said or left out"
    watched = ("paths.output=elsewhere", "data.workers=1", "trainer.accelerator=cpu", "callbacks=default")
    assert folder(*watched, "+hint=${hydra:runtime.output_dir}") != first
    assert folder(*watched) == first
    stops = (
        "+callbacks.stop={_target_: lightning.pytorch.callbacks.EarlyStopping, monitor: val/cd, patience: %d}"
    )
    others = ["scale=cpu", "loss.delta=0.2", "category=lamps", stops % 1, stops % 2]
    assert len({folder(other) for other in others} - {first}) == len(others)


def test_the_environment_counts_in_a_name(monkeypatch):
    words = ("data=deepsdf", "data.source.root=${oc.env:SHAPES}", "seed=0,1")
    names = []
    for value in ("here", "there"):
        monkeypatch.setenv("SHAPES", value)
        names.append([cell.folder for cell in of_multirun(planned_cells, *words)])
    assert len({*names[0], *names[1]}) == 4


def test_shapes_of_a_folder_are_named_by_the_folder():
    (cell, _) = cells("data=folder", "data.source.root=some/my chairs", "seed=0,1")
    assert cell.folder.startswith("folder_my-chairs_") and cell.choices["category"] == "my chairs"
    (cell, _) = cells("data=deepsdf", "category=lamps", "seed=0,1")
    assert cell.choices["category"] == "lamps"


def test_runs_of_one_second_have_folders_of_their_own_and_a_requeued_job_finds_its_own(monkeypatch):
    def folder(*words: str) -> str:
        return of_multirun(lambda config: config.hydra.run.dir, *words, mode=RunMode.RUN)

    monkeypatch.delenv("SLURM_JOB_ID", raising=False)
    assert folder() != folder()
    monkeypatch.setenv("SLURM_JOB_ID", "77")
    assert folder() == folder() != folder("seed=1")


@pytest.fixture
def training(monkeypatch, tmp_path):
    """`python train.py ...` without training."""
    return stand_in(monkeypatch, tmp_path)


SMOKE = ("-m", "sweeps=smoke", "seed=0")


def rows(training) -> list[str]:
    return [config["activation"]["_target_"].rpartition(".")[2] for config in training.configs]


def test_an_interrupted_sweep_goes_on_with_what_is_missing_and_repeats_nothing(training, tmp_path):
    training.stop = lambda config, n: n == 2
    assert training.start(*SMOKE) == 130
    sweep = tmp_path / "outputs" / "sweeps" / "smoke"
    assert [cell.state for cell in read_sweep(sweep)] == ["done", "missing"]
    (checkpoint,) = (read_sweep(sweep)[1].folder / "checkpoints" / "last.ckpt",)
    checkpoint.parent.mkdir()
    checkpoint.touch()
    training.configs = []
    training.stop = lambda config, n: False
    assert training.start("sweeps=smoke", "seed=0") == 0, "with -m or without"
    assert rows(training) == ["Siren"] and training.configs[0]["ckpt_path"] == str(checkpoint)
    assert (sweep / "report" / "report.html").is_file()


def test_a_failing_cell_stops_no_other_and_is_tried_again(training, tmp_path):
    sweep = tmp_path / "outputs" / "sweeps" / "smoke"
    training.fail = lambda config, n: n == 1
    assert training.start(*SMOKE) == 1
    assert rows(training) == ["Relu", "Siren"]
    failure = json.loads((read_sweep(sweep)[0].folder / "failed.json").read_text())
    assert failure["reason"] == "the loss is not finite at step 7" and "Traceback" in failure["traceback"]
    assert failure["reason"] in (sweep / "report" / "report.html").read_text()
    training.configs = []
    training.fail = lambda config, n: False
    assert training.start(*SMOKE) == 0
    assert rows(training) == ["Relu"]
    assert [cell.state for cell in read_sweep(sweep)] == ["done"] * 2


def test_failed_cells_count_where_the_report_breaks(training, monkeypatch):
    def broken(*arguments):
        raise KeyError("a fault of the report's own")

    monkeypatch.setattr("sdfhub.tasks.report.write_report", broken)
    training.fail = lambda config, n: n == 1
    assert training.start(*SMOKE) == 1


def test_groups_that_no_name_tells_are_settings_where_they_are_said():
    planned = cells("sweeps=smoke", "seed=0", "conditioning=concat,film")
    assert [cell.settings for cell in planned] == [{"conditioning": "concat"}, {"conditioning": "film"}] * 2


def test_cells_of_a_nameless_multirun_lie_in_one_folder_of_their_own(training, tmp_path):
    for _ in range(2):
        assert training.start("-m", "activation=relu,siren", "scale=tiny") == 0
    assert len(training.configs) == 4
    both = list((tmp_path / "outputs" / "sweeps").iterdir())
    assert len(both) == 2 and all(len(read_sweep(sweep)) == 2 for sweep in both)


def test_a_cell_that_another_process_trains_is_left_alone(training, tmp_path):
    from filelock import FileLock

    (first, _) = cells(*SMOKE[1:])
    folder = tmp_path / "outputs" / "sweeps" / "smoke" / first.folder
    folder.mkdir(parents=True)
    with FileLock(folder / ".lock"):
        assert training.start(*SMOKE) == 0
    assert rows(training) == ["Siren"]


def test_scores_of_other_settings_or_broken_ones_do_not_count_as_finished(training, tmp_path):
    assert training.start(f"hydra.run.dir={tmp_path}", "seed=3") == 0
    (config,) = training.configs
    whole = (tmp_path / "metrics.json").read_text()
    assert finished(tmp_path, config) == json.loads(whole)
    assert finished(tmp_path, config | {"seed": 4}) is None
    for broken in (whole[:-5], "{}", "[1, 2]", '{"training": {"seconds": "x"}}'):
        (tmp_path / "metrics.json").write_text(broken)
        assert finished(tmp_path, config) is None, broken


@pytest.mark.parametrize(
    ("words", "answer", "status"),
    [
        (["sweeps=smoke,table_small"], "sweeps=smoke,table_small: one sweep or search a command", 2),
        (["sweeps=smoke", "hparams_search=siren"], "one sweep or search a command", 2),
        (["sweeps=table_smal"], "table_small", 1),  # Hydra's own refusal, as below
        (["sweeps=smoke", "seed=0,abc"], "seed", 2),
        (["sweeps=smoke", "experiment=siren,sirenn"], "experiment/sirenn", 1),
    ],
)
def test_a_multirun_that_cannot_be_is_refused_before_a_cell_starts(words, answer, status, training, capsys):
    assert training.start("-m", *words) == status
    told = capsys.readouterr().err
    assert answer in told and "Traceback" not in told and training.configs == []


def test_a_cell_for_several_processes_is_refused_in_a_line(monkeypatch, tmp_path):
    training = stand_in(monkeypatch, tmp_path)
    monkeypatch.undo()
    monkeypatch.chdir(tmp_path)
    ddp = ["trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=2", "data.store=store"]
    assert training.start("-m", "sweeps=smoke", "experiment=fft_siren", "seed=0", *ddp) == 1
    (cell,) = read_sweep(tmp_path / "outputs" / "sweeps" / "smoke")
    assert cell.state == "failed" and re.match("trainer.devices: .* one device", cell.reason)
    assert not (tmp_path / "store").exists(), "before shapes are prepared"
