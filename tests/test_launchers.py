"""A sweep keeps its promises under launchers that run its cells in other processes."""

import subprocess
import sys
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from sdfhub.report.results import read_sweep
from tests.commands import ROOT, Command
from tests.stand_in_training import CONF

SHORT = ["sweeps=smoke", "experiment=fft_siren", "seed=0", "trainer.max_epochs=1", "evaluate.held_out=0"]
SHORT += ["evaluate.train=0", "data.preparation.samples=2000", "data.preparation.surface_points=500"]


def begun(*words: str, **environment: str) -> Command:
    """`train.py -m WORDS`."""
    return Command("-m", *SHORT, *words, **environment)


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("launched")


@pytest.fixture(scope="module")
def places(root) -> list[str]:
    return [f"paths.output={root / 'outputs'}", f"data.store={root / 'store'}"]


@pytest.fixture(scope="module")
def submitted(places) -> tuple[int, str]:
    """A cell that trains and one that fails, as processes of submitit: exit status and output."""
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    command = begun("hydra/launcher=submitit_local", "loss.delta=0.1,-1", *places)
    output = command.output(status=None)
    return command.process.exitcode, output


def test_a_failing_cell_stops_no_other_under_submitit(submitted, root):
    status, output = submitted
    sweep = root / "outputs" / "sweeps" / "smoke"
    assert [cell.state for cell in read_sweep(sweep)] == ["done", "failed"], output[-2000:]
    assert status == 1 and "Traceback" not in output
    assert "delta" in (sweep / "report" / "report.html").read_text()


def test_what_is_finished_is_not_repeated_under_joblib(submitted, root, places):
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    (first,) = (root / "outputs").glob("sweeps/smoke/*/metrics.json")
    written = first.stat().st_mtime_ns
    words = [*SHORT, "hydra/launcher=joblib", "loss.delta=0.1", *places]
    # joblib's processes end with those of a plain interpreter
    subprocess.run([sys.executable, str(ROOT / "train.py"), "-m", *words], check=True, timeout=280)
    assert first.stat().st_mtime_ns == written


def test_the_processes_that_slurm_starts_for_ddp_train_one_cell_together(root, places):
    job = {"SLURM_JOB_ID": "12345", "SLURM_JOB_NAME": "cell", "SLURM_NTASKS": "2", "SLURM_NNODES": "1"}
    job |= {"SLURM_NODELIST": "localhost", "SLURM_NODEID": "0", "SLURM_NTASKS_PER_NODE": "2"}
    words = ["trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=2", f"hydra.sweep.dir={root / 'ddp'}"]
    tasks = [begun(*words, *places, **job, SLURM_PROCID=rank, SLURM_LOCALID=rank) for rank in "01"]
    for task in tasks:
        task.output()
    assert [cell.state for cell in read_sweep(root / "ddp")] == ["done"]


@pytest.mark.parametrize(
    ("launcher", "plugin", "node"),
    [
        ("joblib", "joblib", "JobLibLauncherConf"),
        ("submitit_local", "submitit", "LocalQueueConf"),
        ("submitit_slurm", "submitit", "SlurmQueueConf"),
    ],
)
def test_every_setting_of_a_launcher_is_one_that_its_plugin_knows(launcher, plugin, node):
    known = getattr(pytest.importorskip(f"hydra_plugins.hydra_{plugin}_launcher.config"), node)
    ours = OmegaConf.load(CONF / "hydra" / "launcher" / f"{launcher}.yaml")
    assert set(ours) <= set(known.__dataclass_fields__) and ours._target_ == known()._target_
    assert ours.get("timeout") or ours.get("timeout_min"), "no job may hang for ever"
