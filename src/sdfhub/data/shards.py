"""One prepared shape on disk: a folder of memory-mapped arrays, there whole or not at all."""

import hashlib
import json
import os
import shutil
import time
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import numpy as np

from sdfhub.errors import SdfhubError
from sdfhub.shapes import NormalizedMesh, ShapeSamples

COLUMNS = {"outside": 4, "inside": 4, "surface": 6, "vertices": 3, "faces": 3}
"""Columns of each array: (x, y, z, sdf) twice, (point, normal), position, vertex indices."""

DTYPES = {"outside": "<f4", "inside": "<f4", "surface": "<f4", "vertices": "<f8", "faces": "<i4"}

RECORD = "shape.json"


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
        _write_synced(beside / RECORD, json.dumps(record, indent=1).encode())
        _put_in_place(beside, folder)
    finally:
        shutil.rmtree(beside, ignore_errors=True)
    return record


def remove_leftovers(store: Path) -> None:
    """Removes the half-written shapes of runs that were killed more than an hour ago."""
    for leftover in store.glob("*/.*"):
        if time.time() - leftover.stat().st_mtime > 3600:
            shutil.rmtree(leftover, ignore_errors=True)


def read_record(folder: Path) -> dict | None:
    """The record of a shape whose files all have their full length, or None."""
    try:
        record = json.loads((folder / RECORD).read_text())
        whole = all(
            (folder / f"{name}.npy").stat().st_size == file["bytes"] for name, file in record["files"].items()
        )
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return record if whole else None


def write_whole(path: Path, content: bytes) -> None:
    """Writes a file beside its place, then renames it: a reader sees the old or the new one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f".{path.name}.{uuid.uuid4().hex[:12]}")
    try:
        _write_synced(beside, content)
        os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)


def _write_array(path: Path, array: np.ndarray) -> dict:
    with path.open("wb") as file:
        np.save(file, array, allow_pickle=False)
        file.flush()
        os.fsync(file.fileno())
    return {"rows": len(array), "bytes": path.stat().st_size, "sha256": file_sha256(path)}


def file_sha256(path: Path) -> str:
    """Hex sha256 of a file's content."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _write_synced(path: Path, content: bytes) -> None:
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def _put_in_place(beside: Path, folder: Path) -> None:
    if folder.exists():  # a folder cannot be renamed over a full one: move the old one out of the way first
        old = beside.with_name(beside.name + ".old")
        os.rename(folder, old)
        os.rename(beside, folder)
        shutil.rmtree(old, ignore_errors=True)
    else:
        os.rename(beside, folder)


class StoredShape:
    """One prepared shape; its arrays are mapped when asked for, not read, and `read` opens no map.

    Training draws by `read`: a map costs 0.2 ms to open, and the pages touched through maps that stay open
    would count as this process's memory until they were the whole store.

    Attributes:
        id, category, fingerprint, credits: as the source gave them.
        center: [3] float64, source units; `source = normalised / scale + center`.
        scale: normalised units per source unit.
        statistics: plain numbers about the preparation.
        seconds: what loading and preparing took.
        up: the axis that points up in the source's frame, for pictures.
    """

    def __init__(self, id: str, folder: Path, record: dict, up: Literal["y", "z"] = "z"):
        self.id = id
        self.folder, self.up = folder, up
        self.category: str = record["category"]
        self.fingerprint: str = record["fingerprint"]
        self.credits: dict[str, str] = record["credits"]
        self.center = np.array(record["center"], dtype=np.float64)
        self.scale = float(record["scale"])
        self.statistics: dict[str, float] = record["statistics"]
        self.seconds = float(record["seconds"])
        self._files: dict[str, dict] = record["files"]
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
        return NormalizedMesh(vertices, faces, self.center, self.scale)

    def rows(self, name: str) -> int:
        """Row count of an array (`outside`, `inside`, `surface`) without opening it; 0 if absent."""
        return int(self._files.get(name, {"rows": 0})["rows"])

    def read(self, name: str, start: int, count: int) -> np.ndarray:
        """`count` rows [count, C] of an array from row `start` on; after the last comes the first."""
        if not count:
            return np.zeros((0, COLUMNS[name]), DTYPES[name])
        if name not in self._offsets:
            self._map(name)  # checks the header
        rows, size = self.rows(name), COLUMNS[name] * np.dtype(DTYPES[name]).itemsize
        parts, path = [], self.folder / f"{name}.npy"
        while count:
            part = min(count, rows - start)
            try:
                flat = np.fromfile(
                    path, DTYPES[name], part * COLUMNS[name], offset=self._offsets[name] + start * size
                )
                parts.append(flat.reshape(part, COLUMNS[name]))
            except (OSError, ValueError) as error:
                raise self._broken(name, error) from error
            start, count = 0, count - part
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def damaged(self) -> list[str]:
        """Names of the files whose content no longer has its recorded sha256; reads all of them."""
        return [name for name, file in self._files.items() if not self._is_intact(name, file["sha256"])]

    def _is_intact(self, name: str, sha256: str) -> bool:
        try:
            return file_sha256(self.folder / f"{name}.npy") == sha256
        except OSError:
            return False

    def _map(self, name: str) -> np.ndarray:
        rows, path = self.rows(name), self.folder / f"{name}.npy"
        shape = (rows, COLUMNS[name])
        if not rows:  # an empty file cannot be mapped
            return np.zeros(shape, dtype=DTYPES[name])
        try:
            array = np.load(path, mmap_mode="r", allow_pickle=False)
            if array.shape != shape or array.dtype != np.dtype(DTYPES[name]) or np.isfortran(array):
                raise ValueError(f"holds {list(array.shape)} {array.dtype}")
        except (OSError, ValueError, EOFError) as error:
            raise self._broken(name, error) from error
        self._offsets[name] = array.offset
        return array

    def _broken(self, name: str, error: Exception) -> SdfhubError:
        shape = [self.rows(name), COLUMNS[name]]
        return SdfhubError(
            f"{self.folder / name}.npy: not the {shape} {DTYPES[name]} array that was prepared ({error}); "
            f"delete {self.folder} and the store's manifest.json, then prepare again"
        )
