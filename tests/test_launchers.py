"""A sweep keeps its promises under launchers that run its cells in other processes."""

import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from sdfhub.data.store.store import Store
from sdfhub.errors import SdfhubError
from sdfhub.report.results import read_sweep
from sdfhub.tasks import sweep as sweeps
from sdfhub.tasks import train as train_task
from sdfhub.tasks.prepare import prepare
from tests.test_config import CONF, composed

ROOT = Path(__file__).parents[1]
LAUNCHERS = sorted(path.stem for path in (CONF / "hydra" / "launcher").glob("*.yaml"))
SHARED = ["data.preparation.samples=2000", "data.preparation.surface_points=500"]


def needs(plugin: str):
    """Skips where a launcher's package is not installed; the extra `dev` has it."""
    missing = find_spec("hydra_plugins") is None or find_spec(f"hydra_plugins.{plugin}") is None
    return pytest.mark.skipif(missing, reason=f"{plugin} is not installed")


def run(*words: str) -> subprocess.CompletedProcess:
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    environment.pop("HYDRA_FULL_ERROR", None)
    command = [sys.executable, "-m", "sdfhub", *words]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=280, cwd=ROOT)


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("launched")


@pytest.fixture(scope="module")
def places(root) -> list[str]:
    return [f"output_root={root / 'outputs'}", f"data.store={root / 'store'}"]


@pytest.fixture(scope="module")
def prepared(root, places) -> subprocess.CompletedProcess:
    """One half of the smoke sweep's shapes, and a mistake, in two processes, which start others."""
    smoke = ["sweeps=smoke", "data.workers=2", "experiment=fft_siren", "seed=0"]
    return run("prepare", "-m", "part=1/2,3/2", "hydra/launcher=joblib", *smoke, *SHARED, *places)


@pytest.fixture(scope="module")
def launched(prepared, places):
    """One cell that trains and one that fails, as processes of submitit."""
    words = ["sweeps=smoke", "experiment=fft_siren", "seed=0", "loss.delta=0.1,-1", "trainer.max_epochs=1"]
    words += ["evaluate.known=0", "evaluate.held_out=0", *SHARED, *places]
    return words, run("train", "-m", "hydra/launcher=submitit_local", *words)


@needs("hydra_joblib_launcher")
def test_a_part_is_prepared_and_a_mistake_in_a_worker_is_one_line(prepared, root):
    assert prepared.returncode == 2
    assert "part 1/2: 2 shapes, 2 of them prepared now" in prepared.stdout
    assert prepared.stderr.strip().splitlines()[-1].startswith("sdfhub: error: part=3/2: must be i/n")
    assert "Traceback" not in prepared.stderr and "Warning" not in prepared.stderr
    assert len(list((root / "store").glob("*/*/*/*.safetensors"))) == 2


@needs("hydra_joblib_launcher")
@needs("hydra_submitit_launcher")
def test_a_failing_cell_stops_no_other_under_submitit(launched, root):
    _, done = launched
    assert done.returncode == 1, done.stdout[-2000:] + done.stderr[-2000:]
    assert "1 of 2 cells failed" in done.stderr and "Traceback" not in done.stderr
    assert "delta" in done.stdout, "the table tells the reason"
    sweep = root / "outputs" / "sweeps" / "smoke"
    assert [cell.state for cell in read_sweep(sweep)] == ["done", "failed"]
    logs = "".join(path.read_text() for path in sweep.glob(".submitit/*/*.out"))
    assert "3 shapes kept" in logs
    (index,) = (root / "store").glob("*/*/index.json")
    assert len(Store.open(index.parent)) == 3


@needs("hydra_joblib_launcher")
@needs("hydra_submitit_launcher")
def test_what_is_finished_is_not_repeated_under_joblib(launched, root):
    words, _ = launched
    (first,) = (root / "outputs").glob("sweeps/smoke/*/metrics.json")
    written = first.stat().st_mtime_ns
    again = run("train", "-m", "hydra/launcher=joblib", *words, "loss.delta=0.1")
    assert again.returncode == 0, again.stderr[-2000:]
    assert "finished before" in again.stdout
    assert first.stat().st_mtime_ns == written


@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_a_launcher_that_is_not_installed_says_what_to_install(launcher, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sweeps, "find_spec", lambda name: None)
    monkeypatch.setattr(sys, "argv", ["train.py", "-m", "sweeps=smoke", f"hydra/launcher={launcher}"])
    with pytest.raises(SystemExit) as stop:
        train_task.main()
    told = capsys.readouterr().err.strip()
    assert stop.value.code == 2 and len(told.splitlines()) == 1
    assert f"hydra/launcher={launcher}" in told and "pip install 'sdfhub[" in told


@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_every_setting_of_a_launcher_is_one_that_its_plugin_knows(launcher):
    plugin = "joblib" if launcher == "joblib" else "submitit"
    config = pytest.importorskip(f"hydra_plugins.hydra_{plugin}_launcher.config")
    known = {
        "joblib": "JobLibLauncherConf",
        "submitit_local": "LocalQueueConf",
        "submitit_slurm": "SlurmQueueConf",
    }
    ours = composed_launcher(launcher)
    assert set(ours) <= set(getattr(config, known[launcher]).__dataclass_fields__)
    assert ours["_target_"] == getattr(config, known[launcher])()._target_
    assert ours.get("timeout") or ours.get("timeout_min"), "no job may hang for ever"


def composed_launcher(launcher: str) -> dict:
    return OmegaConf.to_container(OmegaConf.load(CONF / "hydra" / "launcher" / f"{launcher}.yaml"))


@pytest.mark.parametrize("part", ["0/2", "3/2", "2", "a/b", "1/0"])
def test_a_part_that_cannot_be_is_refused(part):
    with pytest.raises(SdfhubError, match="must be i/n"):
        prepare(composed() | {"part": part})


def test_the_processes_that_slurm_starts_for_ddp_train_one_cell_together(root, places):
    words = [sys.executable, "-m", "sdfhub", "train", "-m", "sweeps=smoke", "experiment=fft_siren", "seed=0"]
    words += ["trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=2", "trainer.max_epochs=2"]
    words += ["evaluate.known=0", "evaluate.held_out=0", *SHARED, *places, f"hydra.sweep.dir={root / 'step'}"]
    job = {"SLURM_JOB_ID": "12345", "SLURM_JOB_NAME": "cell", "SLURM_NTASKS": "2", "SLURM_NNODES": "1"}
    job |= {"SLURM_NODELIST": "localhost", "SLURM_NODEID": "0", "SLURM_NTASKS_PER_NODE": "2"}

    def step() -> list[str]:
        tasks = [
            subprocess.Popen(
                words,
                env=os.environ | job | {"SLURM_PROCID": rank, "SLURM_LOCALID": rank, "OMP_NUM_THREADS": "1"},
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                cwd=ROOT,
            )
            for rank in "01"
        ]
        said = [task.communicate(timeout=250)[0] for task in tasks]
        assert [task.returncode for task in tasks] == [0, 0], said
        return said

    assert not any("another process is training it" in text for text in step())
    (metrics,) = (root / "step").glob("*/metrics.json")
    metrics.unlink()
    assert all("goes on from last.ckpt" in text for text in step()), "both take the checkpoint up"
    assert metrics.is_file()


def test_each_cell_of_a_multirun_with_ddp_has_processes_of_its_own(root, places):
    words = [
        "-m",
        "sweeps=smoke",
        "experiment=fft_siren",
        "seed=0,1",
        "trainer.max_epochs=2",
        *SHARED,
        *places,
    ]
    words += ["evaluate.known=0", "evaluate.held_out=0", f"hydra.sweep.dir={root / 'two'}"]
    done = run("train", *words, "trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=2")
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    assert "another process is training it" not in done.stdout
    cells = read_sweep(root / "two")
    assert [cell.state for cell in cells] == ["done", "done"]
    assert [cell.scores.training.made_with["processes"] for cell in cells] == ["2", "2"]
    broken = run(
        "train", *words, "trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=2", "loss.delta=-1"
    )
    assert broken.returncode == 1 and "2 of 2 cells failed" in broken.stderr
    assert "Traceback" not in broken.stderr and "delta" in (broken.stdout + broken.stderr)
