"""Folders of runs: one each, found again under SLURM, and told at once where nothing can be written."""

from types import SimpleNamespace

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig

from sdfhub.callbacks.training_record import made_with
from sdfhub.composition import configuration_folder, plain
from sdfhub.errors import SdfhubError
from sdfhub.multirun.names import register_resolvers
from sdfhub.opening import begin_run
from sdfhub.tasks.train import refuse_other_shapes
from sdfhub.whole_file import refuse_unwritable
from tests.tiny import composed


def run_folder(*words: str) -> str:
    register_resolvers()
    with initialize_config_dir(str(configuration_folder()), version_base="1.3"):
        config = compose("config", list(words), return_hydra_config=True)
        HydraConfig.instance().set_config(config)
        return str(config.hydra.run.dir)


def test_two_runs_of_one_second_have_two_folders(monkeypatch):
    monkeypatch.delenv("SLURM_JOB_ID", raising=False)
    assert len({run_folder() for _ in range(5)}) == 5


def test_a_slurm_job_has_the_same_folder_whenever_it_starts_and_one_for_each_of_its_runs(monkeypatch):
    monkeypatch.setenv("SLURM_JOB_ID", "4711")
    assert run_folder() == run_folder() and "/slurm-4711_" in run_folder()
    assert run_folder("seed=1") != run_folder("seed=2")
    monkeypatch.setenv("SLURM_JOB_ID", "4712")
    assert "/slurm-4712_" in run_folder()


def test_what_was_judged_before_is_no_answer_to_a_training_that_begins(tmp_path):
    (tmp_path / "metrics.json").write_text("{}")
    begin_run(tmp_path, plain(composed()), ["a"], [], {}, "z")
    assert {path.name for path in tmp_path.iterdir()} == {"config.yaml", "split.json", "frames.json"}


def test_a_checkpoint_is_not_continued_on_other_shapes(tmp_path):
    begin_run(tmp_path, plain(composed()), ["a", "b"], [], {}, "z")
    checkpoint = tmp_path / "checkpoints" / "last.ckpt"
    refuse_other_shapes(checkpoint, ["a", "b"])
    for ids, row in ((["a", "c"], 1), (["b", "a"], 0), (["a"], 1), (["a", "b", "c"], 2)):
        with pytest.raises(SdfhubError, match=f"have changed: code {row} is that of"):
            refuse_other_shapes(checkpoint, ids)


def test_a_device_that_is_no_nvidia_gpu_is_written_down_too():
    trainer = SimpleNamespace(
        strategy=SimpleNamespace(root_device=torch.device("mps")), world_size=1, precision="32-true"
    )
    assert made_with(trainer)["device"]


def test_results_that_could_not_be_written_are_refused_before_the_evaluation(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(SdfhubError, match="out: cannot be written"):
        refuse_unwritable(tmp_path / "file" / "out")
