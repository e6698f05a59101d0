"""One prepared shape: one safetensors file of sample rows and the mesh, there whole or not at all.

The file's metadata holds a `Record`, which also says why a shape was rejected; then there are no arrays.
"""

import dataclasses
import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import field
from io import FileIO
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import ConfigDict, PositiveFloat
from pydantic.dataclasses import dataclass

from sdfhub.errors import SdfhubError
from sdfhub.shapes import Frame, NormalizedMesh, ShapeSamples
from sdfhub.whole_file import whole_file

SUFFIX = ".safetensors"

# position, (x, y, z, sdf) twice, (point, normal), vertex indices: in their order in a file, so that all are
# aligned the one of 8 bytes a number first
COLUMNS = {"vertices": 3, "outside": 4, "inside": 4, "surface": 6, "faces": 3}
DTYPES = {"vertices": "<f8", "outside": "<f4", "inside": "<f4", "surface": "<f4", "faces": "<i4"}
_SAFETENSORS_NAMES = {"<f8": "F64", "<f4": "F32", "<i4": "I32"}
_MAX_HEADER = 1 << 20


@dataclass(frozen=True, config=ConfigDict(allow_inf_nan=False))
class Record:
    """What is known of a prepared or rejected shape."""

    fingerprint: str  # this and the next two as the source gave them
    category: str
    credits: dict[str, str]
    seconds: float = 0.0  # that loading and preparing took
    center: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of its frame
    scale: PositiveFloat = 1.0
    statistics: dict[str, float] = field(default_factory=dict)  # about the preparation
    reason: str | None = None  # why the shape was rejected; None where it was not
    detail: str = ""  # of the rejection
    sha256: str = ""  # of all else in the file


def arrays_of(samples: ShapeSamples, seed: int) -> dict[str, np.ndarray]:
    """The arrays kept of one shape; sample rows are shuffled, so that any slice is a random draw."""
    rng, inside = np.random.default_rng(seed), samples.sdf < 0
    rows = np.column_stack([samples.points, samples.sdf])
    surface = np.column_stack([samples.surface_points, samples.surface_normals])
    arrays = {"outside": rows[~inside], "inside": rows[inside], "surface": surface}
    arrays = {name: rng.permutation(array) for name, array in arrays.items()}
    if samples.mesh is not None:
        arrays |= {"vertices": samples.mesh.vertices, "faces": samples.mesh.faces}
    return {name: np.ascontiguousarray(array, dtype=DTYPES[name]) for name, array in arrays.items()}


def write_shape(path: Path, arrays: Mapping[str, np.ndarray], record: Record) -> None:
    """Writes one shape's file: its record, and arrays as `arrays_of` makes them, none if rejected."""
    arrays = {name: arrays[name] for name in COLUMNS if name in arrays}
    header = _header({name: len(array) for name, array in arrays.items()})
    digest = _digest(record, header)
    for array in arrays.values():
        digest.update(array.data)
    record = dataclasses.replace(record, sha256=digest.hexdigest())
    text = json.dumps({"__metadata__": {"record": json.dumps(dataclasses.asdict(record))}} | header).encode()
    text += b" " * (-len(text) % 8)
    with whole_file(path) as file:
        file.write(len(text).to_bytes(8, "little") + text)
        for array in arrays.values():
            file.write(array.data)


def _header(rows: Mapping[str, int]) -> dict[str, dict]:
    """What a safetensors file says of arrays with so many rows that lie one after the other."""
    header, end = {}, 0
    for name, count in rows.items():
        start, end = end, end + count * COLUMNS[name] * np.dtype(DTYPES[name]).itemsize
        dtype = _SAFETENSORS_NAMES[DTYPES[name]]
        header[name] = {"dtype": dtype, "shape": [count, COLUMNS[name]], "data_offsets": [start, end]}
    return header


def _digest(record: Record, header: Mapping[str, dict]) -> "hashlib._Hash":
    """A sha256 that has taken in all of a file but the arrays' numbers."""
    content = [dataclasses.asdict(record) | {"sha256": ""}, header]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode())


class StoredShape:
    """One prepared shape; its arrays are read when asked for, without a map, which costs 0.2 ms to open.

    Arrays: `outside` and `inside` [n, 4] float32 rows (x, y, z, sdf) with sdf >= 0 and < 0, `surface` [M, 6]
    (point, outward unit normal), all shuffled. `up` is the axis that points up in the source's frame; `state`
    changes when the file is written anew. A file that cannot be opened raises OSError, one with a damaged
    header or of another length ValueError.
    """

    def __init__(self, id: str, path: Path, up: Literal["y", "z"] = "z"):
        self.id, self.path, self.up = id, path, up
        with open(path, "rb", opener=_without_links) as file:
            status = os.fstat(file.fileno())
            length = int.from_bytes(file.read(8), "little")
            text = file.read(length) if length <= _MAX_HEADER else b""
        try:
            header = json.loads(text)
            self.record = Record(**json.loads(header.pop("__metadata__")["record"]))
            rows = {name: entry["shape"][0] for name, entry in header.items()}
            self._header = _header(rows)
            if header != self._header or not all(type(n) is int and n >= 0 for n in rows.values()):
                raise ValueError("not the arrays of a shape")
        except Exception as error:  # it may hold anything
            raise ValueError(f"its header is damaged: {error!r}") from error
        self.state, self._size = f"{status.st_size} {status.st_mtime_ns}", status.st_size
        self._start = 8 + length
        size = self._start + max((entry["data_offsets"][1] for entry in header.values()), default=0)
        if size != self._size:
            raise ValueError(f"it has {self._size} bytes, not {size}")
        record = self.record
        self.category, self.credits, self.fingerprint = record.category, record.credits, record.fingerprint
        self.frame = Frame(np.array(record.center), record.scale)

    @property
    def mesh(self) -> NormalizedMesh | None:
        """The oriented mesh behind the samples; None where the source has none."""
        if "faces" not in self._header:
            return None
        return NormalizedMesh(self.read("vertices"), self.read("faces").astype(np.int64), self.frame)

    def rows(self, name: str) -> int:
        """Row count of an array (`outside`, `inside`, `surface`) without opening it; 0 if absent."""
        return self._header[name]["shape"][0] if name in self._header else 0

    def read(self, name: str, start: int = 0, count: int | None = None) -> np.ndarray:
        """`count` rows [count, C] of an array (None: all) from row `start` on, wrapping after the last."""
        rows = np.empty((self.rows(name) if count is None else count, COLUMNS[name]), DTYPES[name])
        self.read_into(rows, name, start)
        return rows

    def read_into(self, rows: np.ndarray, name: str, start: int) -> None:
        """Fills `rows` [n, C], contiguous, with those of an array from row `start` on, as `read` does."""
        if not len(rows):
            return
        count, first = self.rows(name), self._start + self._header[name]["data_offsets"][0]
        start %= count
        with self._opened() as file:
            while len(rows):
                part = rows[: count - start]
                os.preadv(file.fileno(), [part.data], first + start * rows.strides[0])
                rows, start = rows[len(part) :], 0

    def is_intact(self) -> bool:
        """Whether the file's content still has its sha256; reads all of it."""
        with suppress(SdfhubError), self._opened() as file:
            file.seek(self._start)
            digest = hashlib.file_digest(file, lambda: _digest(self.record, self._header))
            return digest.hexdigest() == self.record.sha256
        return False

    @contextmanager
    def _opened(self) -> Iterator[FileIO]:
        try:
            with open(self.path, "rb", 0, opener=_without_links) as file:
                if (size := os.fstat(file.fileno()).st_size) != self._size:
                    raise ValueError(f"it has {size} bytes, not {self._size}")
                yield file
        except (OSError, ValueError) as error:
            why = getattr(error, "strerror", None) or error  # without "[Errno 2]" and the path once more
            raise SdfhubError(f"{self.path}: {why}; start or prepare again: it is made anew") from error


def signed_samples(
    shape: StoredShape, count: int | None, rng: np.random.Generator, rows: np.ndarray | None = None
) -> np.ndarray:
    """[count, 4] samples (None: all), half of them inside, rounded down; in contiguous `rows` if given."""
    if count is None:
        return np.concatenate([shape.read("outside"), shape.read("inside")])
    rows = np.empty((count, 4), np.float32) if rows is None else rows
    draw_rows(rows[: count - count // 2], shape, "outside", rng)
    draw_rows(rows[count - count // 2 :], shape, "inside", rng)
    return rows


def draw_rows(rows: np.ndarray, shape: StoredShape, name: str, rng: np.random.Generator) -> None:
    """Fills rows [n, C], contiguous, with consecutive ones of a shuffled array from a random start."""
    refuse_empty(shape, name, len(rows))
    if len(rows):
        shape.read_into(rows, name, int(rng.integers(shape.rows(name))))


def refuse_empty(shape: StoredShape, name: str, count: int) -> None:
    """Raises SdfhubError where rows are to be drawn of an array that has none."""
    if count and not shape.rows(name):
        raise SdfhubError(f"{shape.id}: holds no {name} samples; see data.preparation, or normals=off")


def _without_links(path: str, flags: int) -> int:
    return os.open(path, flags | getattr(os, "O_NOFOLLOW", 0))
