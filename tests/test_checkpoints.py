"""Checkpoints: whole or not at all, damage found, training stopped anywhere goes on exactly."""

import errno
import multiprocessing
import os
import random
import signal
import time
import warnings
from pathlib import Path

import lightning as L
import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint

from sdfhub.callbacks.checkpoints import StopOnSignal, WholeFileIO
from sdfhub.checkpoint_file import read_checkpoint
from sdfhub.errors import SdfhubError
from sdfhub.model.autodecoder import AutoDecoder
from tests.test_training import batches
from tests.tiny import build_autodecoder, composed, read_weights

STEPS, EPOCHS = 4, 3
CONFIG = composed("decoder.width=16", "decoder.code_size=8", "decoder.dropout=0.1", "optimizer=muon")


@pytest.fixture(autouse=True)
def one_thread():
    """A forked process has none of OpenMP's threads, and would wait for them."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


class At(L.Callback):
    """Does something after a step, as if it came from outside."""

    def __init__(self, step: int, act):
        self.step, self.act = step, act

    def on_train_batch_end(self, trainer, module, *_):
        if trainer.global_step == self.step:
            self.act(trainer, module)


class Steps(torch.utils.data.Dataset):
    """Batches by step, as the training sees them, picklable for loader processes."""

    def __init__(self):
        self.batches = batches(shapes=4, per_step=2, samples=32, surface=8)

    def __getitem__(self, step):
        return self.batches[step]


class Data(L.LightningDataModule):
    def __init__(self, workers: int):
        super().__init__()
        self.workers = workers

    def train_dataloader(self):
        from sdfhub.data.loading.datamodule import EpochSteps

        sampler = EpochSteps(STEPS, done=lambda: self.trainer.global_step)
        return torch.utils.data.DataLoader(
            Steps(), sampler=sampler, batch_size=None, num_workers=self.workers
        )


def trained(
    folder: Path, *callbacks, resume: Path | None = None, every=1, workers=0, epochs=EPOCHS, **settings
):
    """The module after a small training into `folder`."""
    module = build_autodecoder(CONFIG, rows=4)
    last = ModelCheckpoint(folder, "last", every_n_epochs=every, enable_version_counter=False)
    trainer = L.Trainer(
        accelerator="cpu",
        max_epochs=epochs,
        logger=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        use_distributed_sampler=False,
        callbacks=[*callbacks, StopOnSignal(folder), last],
        plugins=WholeFileIO(),
        **settings,
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        trainer.fit(module, datamodule=Data(workers), ckpt_path=resume, weights_only=True)
    return module


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory) -> dict[str, torch.Tensor]:
    return trained(tmp_path_factory.mktemp("undisturbed")).state_dict()


def assert_same(module: L.LightningModule, weights: dict[str, torch.Tensor]) -> None:
    for name, value in module.state_dict().items():
        assert torch.equal(value, weights[name]), name


@pytest.mark.parametrize("step", range(1, STEPS * EPOCHS + 1))
def test_a_training_stopped_after_any_step_ends_bit_by_bit_like_an_undisturbed_one(
    step, tmp_path, undisturbed, caplog
):
    number = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)[step % 3]
    before = signal.getsignal(number)
    with pytest.raises(SystemExit) as stop:
        trained(tmp_path, At(step, lambda *_: os.kill(os.getpid(), number)))
    assert stop.value.code == 128 + number and signal.getsignal(number) == before
    assert f"stopped after step {step}" in caplog.text
    assert read_checkpoint(tmp_path / "last.ckpt")["global_step"] == step
    workers = 1 if step in (3, 8) else 0
    assert_same(trained(tmp_path / "rest", resume=tmp_path / "last.ckpt", workers=workers), undisturbed)


def test_the_last_epoch_is_kept_though_it_is_not_one_of_every_n(tmp_path):
    module = trained(tmp_path, every=2, epochs=1)
    assert read_checkpoint(tmp_path / "last.ckpt")["global_step"] == STEPS
    assert_same(module, read_checkpoint(tmp_path / "last.ckpt")["state_dict"])


def test_a_slurm_job_that_runs_out_of_time_is_queued_again(tmp_path, monkeypatch, undisturbed):
    (tmp_path / "scontrol").write_text(f"#!/bin/sh\necho $* > {tmp_path}/asked\n")
    (tmp_path / "scontrol").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    monkeypatch.setenv("SLURM_JOB_ID", "77")
    with pytest.raises(SystemExit) as stop:
        trained(tmp_path, At(6, lambda *_: os.kill(os.getpid(), signal.SIGUSR1)))
    assert stop.value.code == 143 and (tmp_path / "asked").read_text() == "requeue 77\n"
    assert_same(trained(tmp_path / "rest", resume=tmp_path / "last.ckpt"), undisturbed)


def test_a_hangup_that_is_ignored_stays_ignored(tmp_path):
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does
    try:
        trained(tmp_path, At(2, lambda *_: os.kill(os.getpid(), signal.SIGHUP)), epochs=1)
    finally:
        signal.signal(signal.SIGHUP, before)
    assert read_checkpoint(tmp_path / "last.ckpt")["global_step"] == STEPS


def test_a_stop_waits_for_the_batches_whose_gradients_are_accumulated(tmp_path):
    stops = At(0, lambda *_: os.kill(os.getpid(), signal.SIGTERM))  # with the first of two batches
    with pytest.raises(SystemExit):
        trained(tmp_path, stops, accumulate_grad_batches=2)
    assert read_checkpoint(tmp_path / "last.ckpt")["global_step"] == 1


def spoil(part: str):
    """Puts one NaN into the gradient or the weights of a module."""

    def act(trainer, module):
        weight = module.decoder.get_parameter(next(name for name, _ in module.decoder.named_parameters()))
        if part == "gradient":
            weight.register_hook(lambda gradient: gradient * torch.nan)
        else:
            weight.data.view(-1)[0] = torch.inf

    return act


@pytest.mark.parametrize(
    ("part", "step", "told"),
    [
        ("gradient", 5, r"gradient is not finite at step 5 \(decoder\..*lower optim"),
        ("weights", STEPS * 2, r"model is not finite at step 8 \(decoder\..*lower optim"),
        ("weights", 6, r"loss is not finite at step 6 \((sdf|normal)"),
    ],
)
def test_numbers_that_are_not_finite_stop_a_training_and_spoil_no_checkpoint(part, step, told, tmp_path):
    with pytest.raises(SdfhubError, match=told):
        trained(tmp_path, At(step, spoil(part)))
    kept = read_checkpoint(tmp_path / "last.ckpt")
    assert kept["global_step"] == STEPS
    assert all(torch.isfinite(value).all() for value in kept["state_dict"].values())


def numbers(version: int) -> dict:
    return {"state_dict": {"codes.table": torch.full((400, 400), float(version)), "w": torch.zeros(9)}}


def write_forever(path: Path, first: int) -> None:
    for version in range(first, first + 1000):
        WholeFileIO().save_checkpoint(numbers(version), path)


def test_kills_while_checkpoints_are_written_leave_a_whole_one_and_no_pile(tmp_path, monkeypatch):
    monkeypatch.setenv("TMPDIR", "/dev/shm")  # another file system: renames from there would be copies
    path, chance = tmp_path / "last.ckpt", random.Random(0)
    WholeFileIO().save_checkpoint(numbers(0), path)
    for kill in range(1, 21):
        before = path.stat().st_ino
        writer = multiprocessing.get_context("fork").Process(target=write_forever, args=(path, 1000 * kill))
        writer.start()
        while path.stat().st_ino == before and writer.is_alive():
            time.sleep(0.001)
        time.sleep(chance.random() * 0.03)
        os.kill(writer.pid, signal.SIGKILL)
        writer.join()
        table = read_checkpoint(path)["state_dict"]["codes.table"]
        assert (table == table[0, 0]).all() and table[0, 0] >= 1000 * kill, "the newest whole one"
        assert len(list(tmp_path.iterdir())) <= 2


def test_a_link_in_the_place_of_a_checkpoint_or_its_part_is_not_followed(tmp_path):
    (tmp_path / "other").write_text("precious")
    for name in ("last.ckpt", ".checkpoint.part"):
        (tmp_path / name).symlink_to(tmp_path / "other")
    WholeFileIO().save_checkpoint(numbers(3), tmp_path / "last.ckpt")
    assert (tmp_path / "other").read_text() == "precious"
    assert read_checkpoint(tmp_path / "last.ckpt")["state_dict"]["codes.table"][0, 0] == 3


def test_a_full_disk_names_the_file_and_keeps_the_last_checkpoint(tmp_path, monkeypatch):
    path = tmp_path / "last.ckpt"
    WholeFileIO().save_checkpoint(numbers(1), path)

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left") as caught:
        WholeFileIO().save_checkpoint(numbers(2), path)
    assert caught.value.filename == str(path) and [file.name for file in tmp_path.iterdir()] == ["last.ckpt"]
    assert read_checkpoint(path)["state_dict"]["codes.table"][0, 0] == 1


def test_no_flipped_bit_and_no_cut_is_loaded(tmp_path):
    path, chance = tmp_path / "last.ckpt", random.Random(0)
    content = {"state_dict": {"codes.table": torch.randn(30, 16)}, "global_step": 7}
    WholeFileIO().save_checkpoint(content, path)
    whole = path.read_bytes()
    refused = 0
    for _ in range(300):
        broken, bit = bytearray(whole), chance.randrange(8 * len(whole))
        broken[bit // 8] ^= 1 << bit % 8
        path.write_bytes(broken if bit % 5 else whole[: bit // 8])
        try:
            table = read_weights(path)["codes.table"]
        except SdfhubError as error:
            assert "last.ckpt" in str(error) and "\n" not in str(error)
            refused += 1
        else:  # a bit of the padding between records, which means nothing
            assert torch.equal(table, content["state_dict"]["codes.table"])
    assert refused > 150


@pytest.mark.parametrize("content", [b"", b"text", b"PK\x03\x04" + bytes(100)])
def test_what_is_no_checkpoint_is_refused_by_name(content, tmp_path):
    (tmp_path / "last.ckpt").write_bytes(content)
    with pytest.raises(SdfhubError, match=r"last\.ckpt: not a readable checkpoint"):
        read_weights(tmp_path / "last.ckpt")


class Stranger:
    """Touches a file where it is unpickled."""

    def __init__(self, canary: Path):
        self.canary = canary

    def __reduce__(self):
        return os.system, (f"touch {self.canary}",)


def test_a_strangers_checkpoint_runs_no_code(tmp_path):
    path, canary = tmp_path / "last.ckpt", tmp_path / "canary"
    for content in (Stranger(canary), {"state_dict": {"codes.table": Stranger(canary)}}):
        torch.save(content, path)
        for read in (read_weights, WholeFileIO().load_checkpoint):
            with pytest.raises(SdfhubError, match="not a readable checkpoint"):
                read(path)
    assert not canary.exists()


def test_a_checkpoint_that_claims_more_numbers_than_it_holds_is_refused(tmp_path):
    claim = torch.zeros(1).expand(10**12, 8)
    torch.save({"state_dict": {"codes.table": claim}}, tmp_path / "last.ckpt")
    with pytest.raises(SdfhubError, match="holds no weights of a model"):
        AutoDecoder.load_from_checkpoint(tmp_path / "last.ckpt")
