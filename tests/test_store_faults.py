"""The store under kills, full disks, flipped bits, strangers' manifests and company."""

import errno
import json
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

from sdfhub.data.store import shards, store
from sdfhub.data.store.comparison import COMPARED
from sdfhub.data.store.manifest import MANIFEST, read_manifest
from sdfhub.data.store.store import Store
from sdfhub.errors import SdfhubError
from tests.test_store import Balls, ball, fill

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


def everything(folder: Path) -> dict[str, object]:
    """All files of a store; of its records all but the seconds that each shape took."""
    found: dict[str, object] = {}
    for path in folder.rglob("*"):
        if path.is_file() and path.name not in (".lock", COMPARED):
            name = str(path.relative_to(folder))
            found[name] = (
                timeless(json.loads(path.read_text())) if path.suffix == ".json" else path.read_bytes()
            )
    return found


def timeless(content):
    if isinstance(content, dict):
        return {key: timeless(value) for key, value in content.items() if key != "seconds"}
    return content


@pytest.mark.parametrize("processes", [1, 2])
def test_preparation_killed_again_and_again_ends_with_the_same_store(processes, tmp_path):
    """With kill -9; what a killed process had half written is no shape, and is never counted as one."""
    undisturbed = fill(tmp_path / "whole", SlowBalls(12, tmp_path / "loads")).folder
    source, chance = SlowBalls(12, tmp_path / "loads"), random.Random(processes)
    root, folder = tmp_path / "killed", tmp_path / "killed" / undisturbed.relative_to(tmp_path / "whole")
    for _ in range(6):
        if processes == 1:
            run = FORK.Process(target=fill, args=(root, source))
            run.start()
        else:
            run = subprocess.Popen([sys.executable, "-c", PREPARE, str(root), str(tmp_path / "loads")])
        time.sleep(0.02 + chance.random() * 0.1 if processes == 1 else 1.5 + chance.random())
        os.kill(run.pid, signal.SIGKILL)
        run.join() if processes == 1 else run.wait()
        if read_manifest(folder):
            assert not any(shape.damaged() for shape in Store.open(folder))
        if processes == 2:
            break  # starting an interpreter is slow
    time.sleep(0.3 * (processes - 1))  # workers end a moment after the process that they work for
    fill(root, source)
    for leftover in [*folder.glob(".*"), *folder.glob("*/.*")]:
        os.utime(leftover, (1, 1))  # as if an hour had passed
    (folder / MANIFEST).unlink()  # any run that has something to do clears up
    fill(root, source)
    assert everything(folder) == everything(undisturbed)


PREPARE = """
import sys; from pathlib import Path
from tests.test_store_faults import SlowBalls, fill
if __name__ == "__main__":
    fill(sys.argv[1], SlowBalls(12, Path(sys.argv[2])), workers=2)
"""


def full(*_):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_full_disk_is_told_with_the_file_and_costs_nothing_that_was_there(tmp_path, monkeypatch):
    before = everything(fill(tmp_path, Balls(2)).folder)
    synced = os.fsync
    calls = iter(range(100))
    monkeypatch.setattr(os, "fsync", lambda file: full() if next(calls) >= 8 else synced(file))
    with pytest.raises(SdfhubError, match=r"cannot be written: .*No space left on device: '.*balls"):
        fill(tmp_path, Balls(6))
    monkeypatch.undo()
    after = everything(fill(tmp_path, Balls(2)).folder)
    assert {name: after[name] for name in before if name != MANIFEST} == {
        name: before[name] for name in before if name != MANIFEST
    }
    assert len(fill(tmp_path, Balls(6))) == 6


@pytest.mark.parametrize("damage", ["cut", "empty", "text", "bit", "gone", "object"])
@pytest.mark.parametrize("name", ["outside", "surface", "faces"])
def test_a_damaged_shape_is_named_and_prepared_again(damage, name, tmp_path, capsys):
    before = fill(tmp_path, Balls(3))
    whole = everything(before.folder)
    path = before.folder / "balls/0001" / f"{name}.npy"
    content = bytearray(path.read_bytes())
    content[-7] ^= 4
    match damage:
        case "cut":
            path.write_bytes(content[:-100])
        case "empty":
            path.write_bytes(b"")
        case "text":
            path.write_text("no array")
        case "bit":
            path.write_bytes(content)
        case "gone":
            path.unlink()
        case "object":
            np.save(path, np.array([{}], dtype=object), allow_pickle=True)
    capsys.readouterr()
    after = fill(tmp_path, Balls(3))
    assert f"balls/0001: {name}.npy damaged (checksum): prepared again" in capsys.readouterr().out
    assert everything(after.folder) == whole


def test_an_array_that_claims_forty_terabytes_is_refused_before_memory_is_asked_for(tmp_path):
    prepared = fill(tmp_path, Balls(1))
    path = prepared.folder / "balls/0000/outside.npy"
    with path.open("wb") as file:
        claim = {"descr": "<f4", "fortran_order": False, "shape": (10**13, 4)}
        np.lib.format.write_array_header_1_0(file, claim)
    with pytest.raises(SdfhubError, match=r"outside\.npy: not the .* array that was prepared"):
        prepared["balls/0000"].read("outside", 0, 5)


def test_an_array_that_went_away_is_told_in_words(tmp_path):
    prepared = fill(tmp_path, Balls(1))
    (prepared.folder / "balls/0000/outside.npy").unlink()
    with pytest.raises(SdfhubError, match=r"was prepared \(No such file or directory\); start or prepare"):
        prepared["balls/0000"].read("outside", 0, 5)


def changed(manifest: dict, *path: str, value) -> dict:
    node = manifest
    for key in path[:-1]:
        node = node[key]
    node[path[-1]] = value
    return manifest


@pytest.mark.parametrize("place", [8, 30, 60])
def test_an_array_whose_header_is_damaged_is_named(place, tmp_path):
    prepared = fill(tmp_path, Balls(1))
    path = prepared.folder / "balls/0000/outside.npy"
    content = path.read_bytes()
    path.write_bytes(content[:place] + b'\0"(' + content[place + 3 :])
    with pytest.raises(SdfhubError, match=r"outside\.npy"):
        prepared["balls/0000"].read("outside", 0, 5)


FORGERIES = {
    "an id that leads out": lambda m: changed(m, "shapes", "../../victim", value=m["shapes"]["balls/0000"]),
    "an absolute id": lambda m: changed(m, "shapes", "/etc/victim", value=m["shapes"]["balls/0000"]),
    "a file that leads out": lambda m: changed(
        m, "shapes", "balls/0000", "files", value={"../../../victim": {"rows": 1, "bytes": 1, "sha256": ""}}
    ),
    "negative rows": lambda m: changed(
        m, "shapes", "balls/0000", "files", "outside", "rows", value=-(10**12)
    ),
    "a scale of zero": lambda m: changed(m, "shapes", "balls/0000", "scale", value=0),
    "a number for a name": lambda m: changed(m, "shapes", "balls/0000", "category", value=3),
    "a list for shapes": lambda m: changed(m, "shapes", value=[]),
    "another version": lambda m: changed(m, "version", value=1),
}


@pytest.mark.parametrize("forgery", FORGERIES)
def test_a_manifest_that_a_store_does_not_write_is_not_believed(forgery, tmp_path):
    prepared = fill(tmp_path / "store", Balls(2))
    (tmp_path / "victim").write_text("mine")
    path = prepared.folder / MANIFEST
    path.write_text(json.dumps(FORGERIES[forgery](json.loads(path.read_text()))))
    with pytest.raises(SdfhubError, match=r"holds no manifest\.json"):
        Store.open(prepared.folder)
    assert fill(tmp_path / "store", Balls(2)).ids == prepared.ids  # taken over from the shapes' folders
    assert (tmp_path / "victim").read_text() == "mine"


def test_a_link_out_of_the_store_is_neither_filled_nor_cleared(tmp_path):
    folder = fill(tmp_path / "store", Balls(1)).folder
    victim = tmp_path / "home"
    for name in (".ssh", ".config", ".a.0123456789ab"):
        (victim / name).mkdir(parents=True)
        os.utime(victim / name, (1, 1))
    (folder / "boats").symlink_to(victim)
    source = Balls(1)
    fill(tmp_path / "store", Balls(2))  # clears up what killed runs left
    assert len(list(victim.iterdir())) == 3
    source.listed[0] = type(source.listed[0])("boats/0000", "boats", "v1")
    with pytest.raises(SdfhubError, match="boats: leads out of the store"):
        fill(tmp_path / "store", source)
    assert len(list(victim.iterdir())) == 3


def test_two_processes_prepare_each_shape_of_a_store_once(tmp_path):
    source = SlowBalls(10, tmp_path / "loads")
    runs = [FORK.Process(target=fill, args=(tmp_path, source)) for _ in range(2)]
    for run in runs:
        run.start()
    for run in runs:
        run.join()
    assert [run.exitcode for run in runs] == [0, 0]
    assert len((tmp_path / "loads").read_text().splitlines()) == 10
    assert not any(shape.damaged() for shape in fill(tmp_path, source))


def test_who_waits_for_another_process_says_so(tmp_path, capfd):
    source = SlowBalls(40, tmp_path / "loads")
    run = FORK.Process(target=fill, args=(tmp_path, source))
    run.start()
    while not (tmp_path / "loads").exists():
        time.sleep(0.01)
    assert len(fill(tmp_path, source)) == 40
    run.join()
    assert "waiting for another process that prepares it" in capfd.readouterr().out


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
    fill(tmp_path, Balls(3))
    compared = []
    monkeypatch.setattr(shards, "damaged_files", lambda folder, record: compared.append(folder.name) or [])
    folder = fill(tmp_path, Balls(3)).folder
    assert not compared
    os.utime(folder / "balls/0001/inside.npy", (1, 1))
    fill(tmp_path, Balls(3))
    assert compared == ["0001"]
    (folder / COMPARED).unlink()
    fill(tmp_path, Balls(3))
    assert sorted(compared) == ["0000", "0001", "0001", "0002"]
