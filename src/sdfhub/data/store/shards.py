"""One prepared shape on disk: a folder of memory-mapped arrays, there whole or not at all."""

import json
import os
import re
import shutil
import time
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import numpy as np

from sdfhub.data.store.manifest import Record, StoredFile, checked_record
from sdfhub.errors import SdfhubError
from sdfhub.shapes import Frame, NormalizedMesh, ShapeSamples
from sdfhub.whole_file import file_sha256, whole_file, write_whole

COLUMNS = {"outside": 4, "inside": 4, "surface": 6, "vertices": 3, "faces": 3}
"""Columns of each array: (x, y, z, sdf) twice, (point, normal), position, vertex indices."""

DTYPES = {"outside": "<f4", "inside": "<f4", "surface": "<f4", "vertices": "<f8", "faces": "<i4"}

RECORD = "shape.json"

_LEFTOVER = re.compile(r"\..+\.[0-9a-f]{12}(\.old)?")


def arrays_of(samples: ShapeSamples, seed: int) -> dict[str, np.ndarray]:
    """The arrays kept of one shape; sample rows are shuffled, so that any slice is a random draw."""
    rng = np.random.default_rng(seed)
    rows = np.column_stack([samples.points, samples.sdf])
    surface = np.column_stack([samples.surface_points, samples.surface_normals])
    inside = samples.sdf < 0
    arrays = {
        "outside": rng.permutation(rows[~inside]),
        "inside": rng.permutation(rows[inside]),
        "surface": rng.permutation(surface),
    }
    if samples.mesh is not None:
        arrays |= {"vertices": samples.mesh.vertices, "faces": samples.mesh.faces}
    return {name: np.ascontiguousarray(array, dtype=DTYPES[name]) for name, array in arrays.items()}


def write_shape(folder: Path, arrays: Mapping[str, np.ndarray], record: dict) -> dict:
    """Writes one shape's folder beside its place and renames it into place.

    Args:
        folder: where the shape shall lie; what lies there is replaced.
        arrays: as `arrays_of` makes them; empty for a rejected shape.
        record: plain values to keep in `shape.json`.

    Returns:
        The record with `files`: row count, bytes and sha256 of each array.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    beside = folder.with_name(f".{folder.name}.{uuid.uuid4().hex[:12]}")
    beside.mkdir()
    try:
        files = {name: _write_array(beside / f"{name}.npy", array) for name, array in arrays.items()}
        record = record | {"files": files}
        write_whole(beside / RECORD, json.dumps(record, indent=1))
        _put_in_place(beside, folder)
    finally:
        shutil.rmtree(beside, ignore_errors=True)
    return record


def remove_leftovers(store: Path) -> None:
    """Removes the half-written shapes and files of runs that were killed more than an hour ago."""
    for leftover in [*store.glob(".*"), *store.glob("*/.*")]:
        is_ours = _LEFTOVER.fullmatch(leftover.name) and not leftover.parent.is_symlink()
        if is_ours and time.time() - leftover.lstat().st_mtime > 3600:
            if leftover.is_dir() and not leftover.is_symlink():
                shutil.rmtree(leftover, ignore_errors=True)
            else:
                leftover.unlink(missing_ok=True)


def read_record(folder: Path) -> dict | None:
    """The record of a shape whose files all are as they were written, or None."""
    record = checked_record(folder / RECORD)
    return None if record is None or damaged_files(folder, record) else record


def damaged_files(folder: Path, record: Mapping) -> list[str]:
    """Names of a shape's files whose content no longer has its recorded sha256; reads all of them."""
    return [name for name, file in record.get("files", {}).items() if not _is_intact(folder, name, file)]


def _is_intact(folder: Path, name: str, file: StoredFile) -> bool:
    path = folder / f"{name}.npy"
    try:
        return path.stat().st_size == file["bytes"] and file_sha256(path) == file["sha256"]
    except OSError:
        return False


def _write_array(path: Path, array: np.ndarray) -> dict:
    with whole_file(path) as file:
        header = np.lib.format.header_data_from_array_1_0(array)
        np.lib.format.write_array_header_1_0(file, header)
        file.write(array.data)  # np.save writes the same, but on a full disk does not say so
    return {"rows": len(array), "bytes": path.stat().st_size, "sha256": file_sha256(path)}


def _put_in_place(beside: Path, folder: Path) -> None:
    if folder.exists():  # a folder cannot be renamed over a full one: move the old one out of the way first
        old = beside.with_name(beside.name + ".old")
        os.rename(folder, old)
        os.rename(beside, folder)
        shutil.rmtree(old, ignore_errors=True)
    else:
        os.rename(beside, folder)


class StoredShape:
    """One prepared shape; its arrays are mapped when asked for, not read, and `read_into` opens no map.

    Training draws by `read_into`: a map costs 0.2 ms to open, and the pages touched through maps that stay
    open would count as this process's memory until they were the whole store.

    Attributes:
        id, category, fingerprint, credits: as the source gave them.
        center: [3] float64, source units; `source = normalised / scale + center`.
        scale: normalised units per source unit.
        statistics: plain numbers about the preparation.
        seconds: what loading and preparing took.
        up: the axis that points up in the source's frame, for pictures.
    """

    def __init__(self, id: str, folder: Path, record: Record, up: Literal["y", "z"] = "z"):
        self.id = id
        self.folder, self.up = folder, up
        self.category: str = record["category"]
        self.fingerprint: str = record["fingerprint"]
        self.credits: dict[str, str] = record["credits"]
        self.center = np.array(record["center"], dtype=np.float64)
        self.scale = float(record["scale"])
        self.statistics: dict[str, float] = record["statistics"]
        self.seconds = float(record["seconds"])
        self._files: dict[str, StoredFile] = record["files"]
        self._offsets: dict[str, int] = {}  # of arrays whose header has been checked

    @property
    def outside(self) -> np.ndarray:
        """[n, 4] float32 rows (x, y, z, sdf) with sdf >= 0, shuffled."""
        return self._map("outside")

    @property
    def inside(self) -> np.ndarray:
        """[n, 4] float32 rows (x, y, z, sdf) with sdf < 0, shuffled."""
        return self._map("inside")

    @property
    def surface(self) -> np.ndarray:
        """[M, 6] float32 rows (point, outward unit normal), shuffled; M = 0 where there are none."""
        return self._map("surface")

    @property
    def mesh(self) -> NormalizedMesh | None:
        """The oriented mesh behind the samples, read into memory; None where the source has none."""
        if "faces" not in self._files:
            return None
        vertices, faces = np.array(self._map("vertices")), np.array(self._map("faces"), dtype=np.int64)
        return NormalizedMesh(vertices, faces, Frame(self.center, self.scale))

    def rows(self, name: str) -> int:
        """Row count of an array (`outside`, `inside`, `surface`) without opening it; 0 if absent."""
        return int(self._files.get(name, {"rows": 0})["rows"])

    def read(self, name: str, start: int, count: int) -> np.ndarray:
        """`count` rows [count, C] of an array from row `start` on; after the last comes the first."""
        rows = np.empty((count, COLUMNS[name]), DTYPES[name])
        self.read_into(rows, name, start)
        return rows

    def read_into(self, rows: np.ndarray, name: str, start: int) -> None:
        """Fills `rows` [n, C], contiguous, with those of an array from row `start` on, as `read` does."""
        if not len(rows):
            return
        if name not in self._offsets:
            self._map(name)  # checks the header
        start %= self.rows(name)
        try:
            with open(self.folder / f"{name}.npy", "rb") as file:
                while len(rows):
                    part, rows = np.split(rows, [min(len(rows), self.rows(name) - start)])
                    file.seek(self._offsets[name] + start * part.strides[0])
                    if (found := file.readinto(part.data.cast("B"))) != part.nbytes:
                        raise ValueError(f"{found} of {part.nbytes} bytes")
                    start = 0
        except (OSError, ValueError) as error:
            raise self._broken(name, error) from error

    def damaged(self) -> list[str]:
        """Names of the files whose content no longer has its recorded sha256; reads all of them."""
        return damaged_files(self.folder, {"files": self._files})

    def _map(self, name: str) -> np.ndarray:
        rows, path = self.rows(name), self.folder / f"{name}.npy"
        shape = (rows, COLUMNS[name])
        if not rows:  # an empty file cannot be mapped
            return np.zeros(shape, dtype=DTYPES[name])
        try:
            array = np.load(path, mmap_mode="r", allow_pickle=False)
            if array.shape != shape or array.dtype != np.dtype(DTYPES[name]) or np.isfortran(array):
                raise ValueError(f"holds {list(array.shape)} {array.dtype}")
        except Exception as error:  # numpy parses a header as Python, and a damaged one in many ways
            raise self._broken(name, error) from error
        self._offsets[name] = array.offset
        return array

    def _broken(self, name: str, error: Exception) -> SdfhubError:
        shape = [self.rows(name), COLUMNS[name]]
        why = getattr(error, "strerror", None) or error  # without "[Errno 2]" and the path once more
        return SdfhubError(
            f"{self.folder / name}.npy: not the {shape} {DTYPES[name]} array that was prepared ({why}); "
            "start or prepare again: what is damaged is then made anew"
        )
