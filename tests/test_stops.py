"""Trainings told to stop, killed, queued again or left by one of their processes: whole processes, slow."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from sdfhub.checkpoint_file import read_checkpoint
from tests.commands import ROOT, Command
from tests.test_end_to_end import TINY

pytestmark = pytest.mark.slow


def overrides(tmp_path: Path, folder: Path, epochs: int = 30) -> list[str]:
    return [
        *TINY,
        "data.shapes=4",
        "data.held_out=0",
        "data.loader.passes_per_epoch=10",
        "callbacks=quiet",
        "evaluate.train=1",
        "trainer=cpu",
        f"trainer.max_epochs={epochs}",
        f"data.store={tmp_path / 'store'}",
        f"paths.output={tmp_path / 'outputs'}",
        f"hydra.run.dir={folder}",
    ]


def begun(words: list[str], folder: Path, **environment: str) -> subprocess.Popen:
    """A training that has written its first checkpoint."""
    process = subprocess.Popen(
        [sys.executable, "train.py", *words],
        cwd=ROOT,
        env=os.environ | {"OMP_NUM_THREADS": "1"} | environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    before = list(folder.rglob("last.ckpt"))
    limit = time.monotonic() + 200
    while process.poll() is None and time.monotonic() < limit:
        found = [path for path in folder.rglob("last.ckpt") if path not in before]
        if found and time.time() - found[0].stat().st_mtime > 0.2:
            break
        time.sleep(0.05)
    return process


def weights(folder: Path) -> dict[str, torch.Tensor]:
    return read_checkpoint(folder / "checkpoints" / "last.ckpt")["state_dict"]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory) -> tuple[Path, dict[str, torch.Tensor]]:
    root = tmp_path_factory.mktemp("stops")
    Command(*overrides(root, root / "whole")).output()
    return root, weights(root / "whole")


def assert_same(folder: Path, expected: dict[str, torch.Tensor]) -> None:
    for name, value in weights(folder).items():
        assert torch.equal(value, expected[name]), name


@pytest.mark.parametrize(
    ("number", "status"), [(signal.SIGTERM, 143), (signal.SIGINT, 130), (signal.SIGHUP, 129)]
)
def test_a_training_told_to_stop_leaves_a_checkpoint_its_status_and_goes_on(number, status, undisturbed):
    root, expected = undisturbed
    folder = root / f"a run, stöpped by {number.name}"  # spaces and letters of all kinds
    words = overrides(root, folder)
    words[-1] = f"hydra.run.dir='{folder}'"
    process = begun(words, folder)
    process.send_signal(number)
    told, _ = process.communicate(timeout=60)
    assert process.returncode == status, told
    assert f"{number.name}: stopping after this step" in told and "Traceback" not in told
    assert "continues from last.ckpt" in Command(*words).output()
    assert_same(folder, expected)
    assert "finished before" in Command(*words).output()


def test_a_job_that_slurm_queues_again_goes_on(undisturbed, tmp_path):
    root, expected = undisturbed
    (tmp_path / "scontrol").write_text(f"#!/bin/sh\necho $* >> {tmp_path}/asked\n")
    (tmp_path / "scontrol").chmod(0o755)
    slurm = {"SLURM_JOB_ID": "4711", "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    words = [*overrides(root, root)[:-2], f"paths.output={tmp_path / 'outputs'}"]
    process = begun(words, tmp_path, **slurm)
    process.send_signal(signal.SIGUSR1)
    told, _ = process.communicate(timeout=60)
    assert process.returncode == 143 and (tmp_path / "asked").read_text() == "requeue 4711\n", told
    process = begun(words, tmp_path, **slurm)
    told, _ = process.communicate(timeout=200)
    assert process.returncode == 0 and "continues from last.ckpt" in told
    (folder,) = tmp_path.glob("outputs/*/slurm-4711_*")
    assert_same(folder, expected)


def test_a_training_killed_again_and_again_ends_like_an_undisturbed_one(undisturbed):
    root, expected = undisturbed
    folder = root / "killed"
    for _ in range(3):
        process = begun(overrides(root, folder), folder)
        process.kill()
        process.communicate()
    Command(*overrides(root, folder)).output()
    assert_same(folder, expected)
    assert len(list((folder / "checkpoints").iterdir())) <= 2


def processes_of(word: str) -> list[int]:
    """Ids of the processes with a word on their command line."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            if word.encode() in path.read_bytes():
                found.append(int(path.parent.name))
        except OSError:
            continue
    return sorted(found)


def test_two_processes_told_to_stop_leave_one_checkpoint_and_go_on(undisturbed):
    root, _ = undisturbed
    folder = root / "two_told"
    words = in_two(overrides(root, folder, epochs=40))
    main = begun(words, folder)
    main.send_signal(signal.SIGTERM)
    told, _ = main.communicate(timeout=60)
    assert main.returncode == 143 and "stopped after step" in told and "Traceback" not in told, told
    assert not processes_of(str(folder))
    stopped = read_checkpoint(folder / "checkpoints" / "last.ckpt")["global_step"]
    assert "continues from last.ckpt" in Command(*words).output()
    assert 0 < stopped < read_checkpoint(folder / "checkpoints" / "last.ckpt")["global_step"] == 400


def in_two(words: list[str]) -> list[str]:
    """A training's words for two processes."""
    ddp = ["trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=2"]
    return [word for word in words if word != "trainer=cpu"] + ddp


@pytest.mark.parametrize("victim", [0, 1])
def test_when_one_process_of_many_dies_the_others_end_within_a_minute(victim, undisturbed):
    root, _ = undisturbed
    folder = root / f"two_{victim}"
    main = begun(in_two(overrides(root, folder, epochs=5000)), folder)
    both = processes_of(str(folder))
    assert len(both) >= 2 and main.pid in both
    children = [pid for pid in both if pid != main.pid]
    os.kill(main.pid if victim == 0 else children[0], signal.SIGKILL)
    told, _ = main.communicate(timeout=60)
    limit = time.monotonic() + 60
    while processes_of(str(folder)) and time.monotonic() < limit:
        time.sleep(0.2)
    left = processes_of(str(folder))
    for pid in left:
        os.kill(pid, signal.SIGKILL)
    assert not left
    assert main.returncode != 0
    assert "another process of this run" in told, told[-3000:]


def test_one_shape_and_fewer_shapes_than_a_step_train(tmp_path):
    for shapes in (1, 2):
        words = overrides(tmp_path, tmp_path / str(shapes), epochs=2)
        done = Command(*words, f"data.shapes={shapes}", "data.loader.shapes_per_step=64").output()
        assert f"{shapes} shape" in done and (tmp_path / str(shapes) / "metrics.json").is_file()
