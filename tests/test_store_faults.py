"""The store under kills, full disks, flipped bits, strangers' files and company."""

import errno
import json
import logging
import multiprocessing
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from sdfhub.data.store import store
from sdfhub.data.store.store import INDEX, Store
from sdfhub.data.store.stored_shape import StoredShape
from sdfhub.errors import SdfhubError
from tests.test_store import Balls, ball, content, fill

FORK = multiprocessing.get_context("fork")


class SlowBalls(Balls):
    """Balls that take a moment, so that a kill finds them unfinished; counts what it loads in a file."""

    def __init__(self, count: int, loads: Path):
        super().__init__(count)
        self.loads = loads

    def load(self, shape):
        with self.loads.open("a") as file:
            file.write(f"{shape.id}\n")
        time.sleep(0.01)
        return ball(seed=store.shape_seed(shape), rows=3000)


def names(folder: Path) -> set[str]:
    """All files of a store."""
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("processes", [1, 2])
def test_preparation_killed_again_and_again_ends_with_the_same_store(processes, tmp_path):
    """With kill -9; what a killed process had half written is no shape, and is never counted as one."""
    undisturbed = fill(tmp_path / "whole", SlowBalls(12, tmp_path / "loads"))
    source, chance = SlowBalls(12, tmp_path / "loads"), random.Random(processes)
    root, folder = (
        tmp_path / "killed",
        tmp_path / "killed" / undisturbed.folder.relative_to(tmp_path / "whole"),
    )
    for _ in range(6 if processes == 1 else 1):  # starting an interpreter is slow
        if processes == 1:
            run = FORK.Process(target=fill, args=(root, source))
            run.start()
        else:
            run = subprocess.Popen([sys.executable, "-c", PREPARE, str(root), str(tmp_path / "loads")])
        time.sleep(0.02 + chance.random() * 0.1 if processes == 1 else 1.5 + chance.random())
        os.kill(run.pid, signal.SIGKILL)
        run.join() if processes == 1 else run.wait()
        if list(folder.glob("balls/[0-9]*")):
            assert all(shape.is_intact() for shape in Store.open(folder).values())
    time.sleep(0.6 * (processes - 1))  # workers end a moment after the process that they work for
    for leftover in folder.rglob(".*"):
        os.utime(leftover, (1, 1))  # as if an hour had passed
    (folder / "balls/0000.safetensors").unlink(missing_ok=True)
    assert content(fill(root, source)) == content(undisturbed)
    assert names(folder) == names(undisturbed.folder)


PREPARE = """
import sys; from pathlib import Path
from tests.test_store_faults import SlowBalls, fill
fill(sys.argv[1], SlowBalls(12, Path(sys.argv[2])), workers=2)
"""


def full(*_):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_full_disk_is_told_with_the_file_and_costs_nothing_that_was_there(tmp_path, monkeypatch):
    before = fill(tmp_path, Balls(2))
    kept = content(before)
    synced, calls = os.fsync, iter(range(100))
    monkeypatch.setattr(os, "fsync", lambda file: full() if next(calls) >= 2 else synced(file))
    with pytest.raises(SdfhubError, match=r"cannot be written: .*No space left on device: '.*balls"):
        fill(tmp_path, Balls(6))
    monkeypatch.undo()
    assert names(before.folder) == {".lock", INDEX, *(f"balls/000{i}.safetensors" for i in range(4))}
    assert content(fill(tmp_path, Balls(2))) == kept
    assert len(fill(tmp_path, Balls(6))) == 6


@pytest.mark.parametrize("damage", ["cut", "longer", "empty", "text", "bit", "header"])
def test_a_damaged_shape_is_named_and_prepared_again(damage, tmp_path, caplog):
    before = fill(tmp_path, Balls(3))
    whole, path = content(before), before["balls/0001"].path
    written = bytearray(path.read_bytes())
    match damage:
        case "cut":
            del written[-100:]
        case "longer":
            written += b"more"
        case "empty":
            written.clear()
        case "text":
            written[:] = b"no array"
        case "bit":
            written[-7] ^= 4
        case "header":
            written[written.index(b"balls")] ^= 1
    path.write_bytes(written)
    after = fill(tmp_path, Balls(3))
    (line,) = [line for line in caplog.messages if "damaged" in line]
    assert "balls/0001.safetensors: damaged" in line and line.endswith("to be prepared again")
    assert content(after) == whole


@pytest.mark.parametrize("damage", ["cut", "gone", "link"])
def test_a_file_that_changes_while_it_is_used_is_named(damage, tmp_path):
    shape = fill(tmp_path, Balls(1))["balls/0000"]
    whole = shape.path.read_bytes()
    shape.path.unlink()
    if damage == "cut":
        shape.path.write_bytes(whole[:-100])
    elif damage == "link":
        (tmp_path / "other").write_bytes(whole)
        shape.path.symlink_to(tmp_path / "other")
    for use in (lambda: shape.read("outside", 0, 5), lambda: shape.read("inside")):
        with pytest.raises(SdfhubError, match=r"balls/0000\.safetensors: .*; start or prepare again"):
            use()
    assert not shape.is_intact() or damage == "cut"


def forged(path: Path, change) -> None:
    """Writes a shape's file anew with a changed header."""
    whole = path.read_bytes()
    end = 8 + int.from_bytes(whole[:8], "little")
    header = json.loads(whole[8:end])
    change(header)
    text = json.dumps(header).encode()
    path.write_bytes(len(text).to_bytes(8, "little") + text + whole[end:])


def record(**changes):
    def change(header):
        header["__metadata__"]["record"] = json.dumps(json.loads(header["__metadata__"]["record"]) | changes)

    return change


FORGERIES = {
    "forty terabytes": lambda h: h["outside"].update(shape=[10**13, 4], data_offsets=[0, 16 * 10**13]),
    "negative rows": lambda h: h["outside"].update(shape=[-4, 4]),
    "another type": lambda h: h["outside"].update(dtype="F64"),
    "rows twice": lambda h: h["inside"].update(data_offsets=h["outside"]["data_offsets"]),
    "another array": lambda h: h.update(strange=h.pop("outside")),
    "a list of arrays": lambda h: h.update(outside=[]),
    "no record": lambda h: h.pop("__metadata__"),
    "a scale of zero": record(scale=0),
    "a number for a name": record(category=3),
    "nowhere": record(center=[0, float("nan"), 0]),
}


@pytest.mark.parametrize("forgery", FORGERIES)
def test_a_file_that_a_store_does_not_write_is_not_believed(forgery, tmp_path):
    path = fill(tmp_path, Balls(2))["balls/0000"].path
    forged(path, FORGERIES[forgery])
    with pytest.raises(ValueError, match="header|bytes|validation"):
        StoredShape("balls/0000", path)
    assert len(fill(tmp_path, Balls(2))) == 2
    assert StoredShape("balls/0000", path).is_intact()


def test_a_header_that_claims_gigabytes_is_not_read(tmp_path):
    path = fill(tmp_path, Balls(1))["balls/0000"].path
    with path.open("r+b") as file:
        file.write((1 << 40).to_bytes(8, "little"))
    with pytest.raises(ValueError, match="header"):
        StoredShape("balls/0000", path)


def test_a_link_out_of_the_store_is_neither_filled_nor_cleared_nor_read(tmp_path):
    folder = fill(tmp_path / "store", Balls(1)).folder
    victim = tmp_path / "home"
    victim.mkdir()
    for name in (".a.0123456789ab", "0000.safetensors"):
        (victim / name).touch()
        os.utime(victim / name, (1, 1))
    (folder / "boats").symlink_to(victim)
    source = Balls(1)
    fill(tmp_path / "store", Balls(2))  # clears up what killed runs left
    source.listed[0] = type(source.listed[0])("boats/0000", "boats", "v1")
    with pytest.raises(SdfhubError, match="boats: leads out of the store"):
        fill(tmp_path / "store", source)
    assert "boats/0000" not in Store.open(folder)
    assert len(list(victim.iterdir())) == 2 and (victim / "0000.safetensors").stat().st_size == 0


def test_two_processes_prepare_each_shape_of_a_store_once(tmp_path):
    source = SlowBalls(10, tmp_path / "loads")
    runs = [FORK.Process(target=fill, args=(tmp_path, source)) for _ in range(2)]
    for run in runs:
        run.start()
    for run in runs:
        run.join()
    assert [run.exitcode for run in runs] == [0, 0]
    assert len((tmp_path / "loads").read_text().splitlines()) == 10
    assert all(shape.is_intact() for shape in fill(tmp_path, source).values())


def test_who_waits_for_another_process_says_so(tmp_path, caplog):
    caplog.set_level(logging.INFO)
    source = SlowBalls(40, tmp_path / "loads")
    run = FORK.Process(target=fill, args=(tmp_path, source))
    run.start()
    while not (tmp_path / "loads").exists():
        time.sleep(0.01)
    assert len(fill(tmp_path, source)) == 40
    run.join()
    assert "waiting for another process that prepares it" in caplog.text


def test_a_store_that_cannot_be_written_is_told_before_a_shape_is_prepared(tmp_path):
    (tmp_path / "file").write_text("in the way")
    source = SlowBalls(2, tmp_path / "loads")
    with pytest.raises(SdfhubError, match="store cannot be written"):
        fill(tmp_path / "file" / "store", source)
    assert not (tmp_path / "loads").exists()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_read_only_store_that_has_everything_is_used(tmp_path):
    folder = fill(tmp_path, Balls(2)).folder
    folder.chmod(0o500)
    try:
        assert len(fill(tmp_path, Balls(2))) == 2
        with pytest.raises(SdfhubError, match="cannot be written"):
            fill(tmp_path, Balls(3))
    finally:
        folder.chmod(0o700)


def test_files_are_compared_again_only_when_their_date_or_size_has_changed(tmp_path, monkeypatch):
    fill(tmp_path, Balls(3))
    compared = []
    monkeypatch.setattr(StoredShape, "is_intact", lambda shape: not compared.append(shape.id))
    folder = fill(tmp_path, Balls(3)).folder
    assert not compared
    os.utime(folder / "balls/0001.safetensors", (1, 1))
    fill(tmp_path, Balls(3))
    assert compared == ["balls/0001"]
    (folder / INDEX).unlink()
    fill(tmp_path, Balls(3))
    assert sorted(compared[1:]) == ["balls/0000", "balls/0001", "balls/0002"]


def test_an_array_that_is_read_wraps_around(tmp_path):
    shape = fill(tmp_path, Balls(1))["balls/0000"]
    assert np.array_equal(shape.read("outside", shape.rows("outside") - 1, 2)[1], shape.read("outside")[0])
