"""The store of prepared shapes: samples are made once and read ever after.

    root / source name / hash of the preparation / shape id.safetensors
                                                 / index.json, a cache: which files have been checked

Each shape's file is written beside its place and renamed. Files whose size or date have changed since their
checksum was compared are compared again, and prepared again where they are damaged.
"""

import hashlib
import json
import logging
import os
import re
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from tqdm import tqdm

from sdfhub.data.preparation.sampling import prepare_mesh
from sdfhub.data.preparation.settings import Preparation
from sdfhub.data.sources.source import Shape, Source
from sdfhub.data.store.stored_shape import SUFFIX, Record, StoredShape, arrays_of, write_shape
from sdfhub.data.workers import Crashed, map_in_processes
from sdfhub.described import describe
from sdfhub.errors import RejectedMesh, SdfhubError
from sdfhub.locks import locked
from sdfhub.shapes import SHAPE_ID, ShapeSamples
from sdfhub.whole_file import write_whole

log = logging.getLogger(__name__)

VERSION = 3  # of the layout on disk and of how samples are made; other stores are not reused
INDEX = "index.json"
TRIED_AGAIN = ("error", "crash")  # reasons that lie in the machine or the program rather than the mesh


class Store(dict[str, StoredShape]):
    """The usable ones of the `shapes` asked for by id, in their order; the others are in `rejected` alone."""

    def __init__(self, folder: Path, shapes: Iterable[StoredShape]):
        shapes = list(shapes)
        super().__init__({shape.id: shape for shape in shapes if not shape.record.reason})
        self.folder = folder
        self.rejected: dict[str, Record] = {shape.id: shape.record for shape in shapes if shape.record.reason}

    @classmethod
    def open(cls, folder: Path, up: Literal["y", "z"] = "z") -> "Store":
        """All shapes whose files lie in `folder`; raises SdfhubError where there are none."""
        paths = (file.relative_to(folder).as_posix() for file in folder.rglob(f"*{SUFFIX}"))
        ids = sorted(id for path in paths if re.fullmatch(SHAPE_ID, id := path.removesuffix(SUFFIX)))
        if not ids:
            raise SdfhubError(f"{folder}: holds no prepared shapes; run `sdfhub prepare` first")
        return cls(folder, _read(folder, ids, up, logging.WARNING).values())

    def __missing__(self, id: str) -> StoredShape:
        why = f"was rejected: {self.rejected[id].reason}" if id in self.rejected else "is not there"
        raise SdfhubError(f"{self.folder}: shape {id} {why}")

    def summary(self) -> str:
        """Kept, rejected by reason, seconds a shape: lines for a reader."""
        seconds = sum(shape.record.seconds for shape in self.values()) / max(1, len(self))
        such = {record.reason: f"{id} ({record.detail})" for id, record in self.rejected.items()}
        counts = Counter(record.reason for record in self.rejected.values()).most_common()
        rejected = "".join(f"\n  rejected {n} x {reason}, such as {such[reason]}" for reason, n in counts)
        kept = f"{len(self)} shapes kept, {len(self.rejected)} rejected"
        return f"{kept}; preparing took {seconds:.2f} s a shape{rejected}"


def prepare(
    source: Source, shapes: list[Shape], preparation: Preparation, root: Path, workers: int | None = None
) -> Store:
    """The store holding `shapes`, preparing those that it lacks.

    A shape is prepared again when its fingerprint, the preparation or VERSION changes, or its file is
    damaged. Its randomness derives from its id and fingerprint, so neither the order nor the number of
    workers (None: one per core; 1: none but this process) matters. `root` is the folder of all stores.
    """
    folder = root / source.name / preparation_hash(preparation)
    stored = _checked(folder, shapes, source, preparation, logging.DEBUG)
    if _left(shapes, stored):
        waiting = f"store: {folder}: waiting for another process that prepares it"
        with _writing(folder), locked(folder / ".lock", waiting=waiting):
            _remove_leftovers(folder)
            prepare_part(source, shapes, preparation, root, workers)
        stored = _checked(folder, shapes, source, preparation)
    store = Store(folder, (stored[shape.id] for shape in shapes))
    if shapes and not len(store):
        what = store.summary().replace("\n  ", "; ")
        raise SdfhubError(f"none of the {len(shapes)} shapes of data={source.name} is usable: {what}")
    return store


def prepare_part(
    source: Source, shapes: list[Shape], preparation: Preparation, root: Path, workers: int | None = None
) -> int:
    """Prepares those of `shapes` that the store lacks, also beside other machines; returns their number."""
    folder = root / source.name / preparation_hash(preparation)
    with _writing(folder):
        left = _left(shapes, _checked(folder, shapes, source, preparation))
        workers = max(1, min(workers or os.cpu_count() or 1, len(left)))
        results = map_in_processes(partial(prepare_shape, source, preparation, folder), left, workers)
        # disable=None: no bar where nobody watches
        bar = tqdm(results, total=len(left), desc=f"preparing {source.name}", unit="shape", disable=None)
        for index, result in bar:
            if isinstance(result, Crashed):
                what = "the worker process died: out of memory, or a fault in a native library"
                record = _record(left[index], what, reason="crash")
                write_shape(folder / f"{left[index].id}{SUFFIX}", {}, record)
    return len(left)


def preparation_hash(preparation: Preparation) -> str:
    """12 hex digits that change with every setting of the preparation and with VERSION."""
    settings = json.dumps([VERSION, asdict(preparation)], sort_keys=True, default=describe)
    return hashlib.sha256(settings.encode()).hexdigest()[:12]


def shape_seed(shape: Shape | StoredShape) -> int:
    """The seed of a shape's samples: 63 bits of a hash of its id and fingerprint."""
    digest = hashlib.sha256(f"{shape.id}\n{shape.fingerprint}".encode()).digest()
    return int.from_bytes(digest[:8], "big") >> 1


def prepare_shape(source: Source, preparation: Preparation, folder: Path, shape: Shape) -> None:
    """Loads, samples and writes one shape, or why it is rejected; only the store can make it fail."""
    start, seed = time.perf_counter(), shape_seed(shape)
    arrays: dict[str, np.ndarray] = {}
    try:
        loaded = source.load(shape)
        samples = loaded if isinstance(loaded, ShapeSamples) else prepare_mesh(loaded, preparation, seed)
        arrays = arrays_of(samples, seed)
        frame, statistics = samples.frame, samples.statistics
        record = _record(shape, center=frame.center.tolist(), scale=frame.scale, statistics=statistics)
    except RejectedMesh as rejection:
        record = _record(shape, rejection.detail, reason=rejection.reason)
    except Exception as error:  # whatever a strange mesh provokes, the other shapes go on
        record = _record(shape, f"{type(error).__name__}: {error}", reason="error")
    seconds = round(time.perf_counter() - start, 4)
    write_shape(folder / f"{shape.id}{SUFFIX}", arrays, replace(record, seconds=seconds))


def _record(shape: Shape, detail: str = "", **known: Any) -> Record:
    detail = detail.encode(errors="replace").decode()  # a path in it may hold bytes of another encoding
    return Record(shape.fingerprint, shape.category, shape.credits, detail=detail, **known)


def _left(shapes: list[Shape], stored: dict[str, StoredShape]) -> list[Shape]:
    """The shapes that are not in the store as they are now."""
    final = {id: shape.fingerprint for id, shape in stored.items() if shape.record.reason not in TRIED_AGAIN}
    return [shape for shape in shapes if final.get(shape.id) != shape.fingerprint]


def _read(folder: Path, ids: Iterable[str], up: Literal["y", "z"], level: int) -> dict[str, StoredShape]:
    """The stored shapes of some ids, in their order, without those that are missing or clearly damaged."""
    paths = {id: folder / f"{id}{SUFFIX}" for id in ids}
    for parent in {path.parent for path in paths.values()}:
        if not parent.resolve().is_relative_to(folder.resolve()):
            raise SdfhubError(f"{parent}: leads out of the store; remove that link")
    stored = {}
    for id, path in paths.items():
        try:
            stored[id] = StoredShape(id, path, up)
        except FileNotFoundError:
            pass
        except (OSError, ValueError) as error:
            log.log(level, "store: %s: damaged (%s): to be prepared again", path, error)
    return stored


def _checked(
    folder: Path, shapes: list[Shape], source: Source, preparation: Preparation, level: int = logging.WARNING
) -> dict[str, StoredShape]:
    """The stored shapes whose files are intact, by id; the index notes which these are."""
    stored = _read(folder, [shape.id for shape in shapes], source.up, level)
    try:
        known = json.loads((folder / INDEX).read_text(encoding="utf-8"))["checked"]
        changed = {id: shape for id, shape in stored.items() if known.get(id) != shape.state}
    except Exception:  # it is not there, or holds anything
        known, changed = {}, dict(stored)
    with ThreadPoolExecutor() as pool:  # hashing lets other threads run
        intact = dict(zip(changed, pool.map(StoredShape.is_intact, changed.values()), strict=True))
    for id in [id for id, is_intact in intact.items() if not is_intact]:
        log.log(level, "store: %s: damaged (checksum): to be prepared again", stored.pop(id).path)
    states = {id: stored[id].state for id in changed if id in stored}
    if states:
        about = {"source": source.name} | asdict(preparation)
        index = {"about": about, "checked": dict(sorted((known | states).items()))}
        with suppress(OSError):  # a store that others own is read all the same
            write_whole(folder / INDEX, json.dumps(index, indent=1, default=describe))
    return stored


def _remove_leftovers(folder: Path) -> None:
    """Removes the half-written files of runs that were killed more than an hour ago."""
    for file in folder.rglob(".*"):
        if re.fullmatch(r"\..+\.[0-9a-f]{12}", file.name) and time.time() - file.lstat().st_mtime > 3600:
            file.unlink(missing_ok=True)


@contextmanager
def _writing(folder: Path) -> Iterator[None]:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield
    except OSError as error:
        raise SdfhubError(f"{folder}: the store cannot be written: {error}") from error
