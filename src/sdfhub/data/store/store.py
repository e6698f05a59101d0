"""The store of prepared shapes: samples are made once and mapped into memory ever after.

    root / source name / hash of the preparation / shape id.safetensors
                                                 / index.json, a cache: which files have been checked

Each shape's file is written beside its place and renamed. Files whose size or date have changed since their
checksum was compared are compared again, and prepared again where they are damaged.
"""

import dataclasses
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
from pathlib import Path
from typing import Literal

from tqdm import tqdm

from sdfhub.data.preparation.sampling import Preparation, prepare_mesh
from sdfhub.data.sources.source import Shape, Source
from sdfhub.data.store.stored_shape import SUFFIX, Record, StoredShape, arrays_of, write_shape
from sdfhub.data.workers import Crashed, map_in_processes
from sdfhub.errors import RejectedMesh, SdfhubError
from sdfhub.locks import locked
from sdfhub.shapes import SHAPE_ID, ShapeSamples, check_id
from sdfhub.whole_file import write_whole

log = logging.getLogger(__name__)

VERSION = 3
"""Of the layout on disk and of how samples are made; stores of another version are not reused."""

INDEX = "index.json"

TRIED_AGAIN = ("error", "crash")
"""Reasons that lie in the machine or the program rather than the mesh: such shapes are tried again."""

_LEFTOVER = re.compile(r"\..+\.[0-9a-f]{12}")


class Store:
    """Prepared shapes of one source under one preparation.

    Args:
        folder: of the store.
        shapes: those wanted of it; the rejected ones are listed in `rejected` alone.
    """

    def __init__(self, folder: Path, shapes: Iterable[StoredShape]):
        shapes = list(shapes)
        self.folder = folder
        self.rejected: dict[str, Record] = {shape.id: shape.record for shape in shapes if shape.record.reason}
        self._shapes = {shape.id: shape for shape in shapes if not shape.record.reason}

    @classmethod
    def open(cls, root: str | Path, ids: Iterable[str] | None = None) -> "Store":
        """The store whose files lie in `root`, limited to `ids`; None takes all it has.

        Raises:
            SdfhubError: no prepared shapes there, or a shape that was never prepared.
        """
        folder = Path(root)
        there = _ids_in(folder)
        if not there:
            raise SdfhubError(f"{root}: holds no prepared shapes; run `sdfhub prepare` first")
        ids = there if ids is None else list(ids)
        shapes = _read(folder, [id for id in ids if id in set(there)])
        if missing := [id for id in ids if id not in shapes]:
            raise SdfhubError(f"{folder}: shape {missing[0]} has not been prepared; run `sdfhub prepare`")
        return cls(folder, shapes.values())

    @property
    def ids(self) -> list[str]:
        """The kept shapes, in the order asked for."""
        return list(self._shapes)

    def __len__(self) -> int:
        return len(self._shapes)

    def __contains__(self, id: str) -> bool:
        return id in self._shapes

    def __iter__(self) -> Iterator[StoredShape]:
        return iter(self._shapes.values())

    def __getitem__(self, id: str) -> StoredShape:
        if id in self.rejected:
            raise SdfhubError(f"shape {id} was rejected: {self.rejected[id].reason}")
        if id not in self._shapes:
            raise SdfhubError(f"shape {id} is not among the {len(self)} shapes opened from {self.folder}")
        return self._shapes[id]

    def summary(self) -> str:
        """Kept, rejected by reason, seconds a shape: lines for a reader."""
        reasons = Counter(record.reason for record in self.rejected.values())
        seconds = sum(shape.record.seconds for shape in self) / max(1, len(self))
        kept = f"{len(self)} shapes kept, {len(self.rejected)} rejected"
        lines = [f"{kept}; preparing took {seconds:.2f} s a shape"]
        for reason, count in reasons.most_common():
            id, detail = next((id, r.detail) for id, r in self.rejected.items() if r.reason == reason)
            lines.append(f"  rejected {count} x {reason}, such as {id} ({detail})")
        return "\n".join(lines)


def prepare(
    source: Source,
    shapes: list[Shape],
    preparation: Preparation,
    root: str | Path,
    workers: int | None = None,
    progress: bool = True,
) -> Store:
    """The store holding `shapes`, preparing those that it lacks.

    A shape is prepared again when its fingerprint, the preparation or VERSION changes, or its file is
    damaged. Its randomness derives from its id and fingerprint, so neither the order nor the number of
    workers matters.

    Args:
        source: picklable; loads the shapes.
        shapes: what is wanted.
        preparation: the settings, part of the store's folder name.
        root: folder of all stores.
        workers: processes; None takes one per core, 1 works in this process.
        progress: show a bar.

    Raises:
        SdfhubError: not one shape could be prepared, or the store cannot be written.
    """
    folder = Path(root) / source.name / preparation_hash(preparation)
    stored = _checked(folder, shapes, source)
    if _left(shapes, stored):
        with _writing(folder), locked(folder / ".lock", waiting=f"store: {folder}: {_WAITING}"):
            _remove_leftovers(folder)
            # another process may have filled it meanwhile
            left = _left(shapes, _checked(folder, shapes, source, logging.WARNING))
            made: list[str] = []
            try:
                for shape, result in _prepared(source, left, preparation, folder, workers, progress):
                    if isinstance(result, Crashed):
                        write_shape(_file(folder, shape.id), {}, _rejection(shape, "crash", _CRASH))
                    made.append(shape.id)
            finally:  # a run that is interrupted keeps what it has
                fresh = _read(folder, made, source.up)
                _remember(folder, fresh, {"source": source.name} | dataclasses.asdict(preparation))
        stored = _checked(folder, shapes, source)
    store = Store(folder, (stored[shape.id] for shape in shapes))
    if shapes and not len(store):
        what = "; ".join(line.strip() for line in store.summary().splitlines())
        raise SdfhubError(f"none of the {len(shapes)} shapes of data={source.name} is usable: {what}")
    return store


def prepare_part(
    source: Source,
    shapes: list[Shape],
    preparation: Preparation,
    root: str | Path,
    workers: int | None = None,
    progress: bool = True,
) -> int:
    """Prepares some of a store's shapes; several processes or machines may do so side by side.

    Args:
        shapes: this part's own; the other arguments are those of `prepare`.

    Returns:
        How many were prepared or rejected; the others were there, or are left to the next call, since
        their worker died.

    Raises:
        SdfhubError: the store cannot be written.
    """
    folder = Path(root) / source.name / preparation_hash(preparation)
    with _writing(folder):
        left = _left(shapes, _checked(folder, shapes, source, logging.WARNING))
        results = _prepared(source, left, preparation, folder, workers, progress)
        return sum(not isinstance(result, Crashed) for _, result in results)


def preparation_hash(preparation: Preparation) -> str:
    """12 hex digits that change with every setting of the preparation and with VERSION."""
    settings = json.dumps([VERSION, dataclasses.asdict(preparation)], sort_keys=True)
    return hashlib.sha256(settings.encode()).hexdigest()[:12]


def shape_seed(shape: Shape | StoredShape) -> int:
    """The seed of a shape's samples: 63 bits of a hash of its id and fingerprint."""
    digest = hashlib.sha256(f"{shape.id}\n{shape.fingerprint}".encode()).digest()
    return int.from_bytes(digest[:8], "big") >> 1


def prepare_shape(source: Source, shape: Shape, preparation: Preparation, folder: Path) -> None:
    """Loads, samples and writes one shape, or the reason why it is rejected. Never raises for a bad mesh.

    Raises:
        OSError: the store cannot be written, which no other shape would survive either.
    """
    start = time.perf_counter()
    arrays = {}
    try:
        loaded = source.load(shape)
        is_sampled = isinstance(loaded, ShapeSamples)
        samples = loaded if is_sampled else prepare_mesh(loaded, preparation, shape_seed(shape))
        arrays = arrays_of(samples, shape_seed(shape))
        statistics = {name: float(value) for name, value in samples.statistics.items()}
        record = Record(shape.fingerprint, shape.category, shape.credits, statistics=statistics)
        center = tuple(samples.center.tolist())
        record = dataclasses.replace(record, center=center, scale=float(samples.scale))
    except RejectedMesh as rejection:
        record = _rejection(shape, rejection.reason, rejection.detail)
    except Exception as error:  # whatever a strange mesh provokes, the other shapes go on
        record = _rejection(shape, "error", f"{type(error).__name__}: {error}")
    seconds = round(time.perf_counter() - start, 4)
    write_shape(_file(folder, shape.id), arrays, dataclasses.replace(record, seconds=seconds))


@dataclasses.dataclass(frozen=True)
class _PrepareShape:
    """`prepare_shape` with all but the shape filled in; pickles into worker processes."""

    source: Source
    preparation: Preparation
    folder: Path

    def __call__(self, shape: Shape) -> None:
        prepare_shape(self.source, shape, self.preparation, self.folder)


_WAITING = "waiting for another process that prepares it"
_CRASH = "the worker process died: out of memory, or a fault in a native library"


def _rejection(shape: Shape, reason: str, detail: str) -> Record:
    detail = detail.encode(errors="replace").decode()  # a path in it may hold bytes of another encoding
    return Record(shape.fingerprint, shape.category, shape.credits, reason=reason, detail=detail)


def _prepared(source, left, preparation, folder, workers, progress) -> Iterator[tuple[Shape, Crashed | None]]:
    workers = max(1, min(workers or os.cpu_count() or 1, len(left)))
    function = _PrepareShape(source, preparation, folder)
    if workers == 1:
        results = ((index, function(shape)) for index, shape in enumerate(left))
    else:
        results = map_in_processes(function, left, workers)
    quiet = None if progress else True  # None: no bar where nobody watches
    bar = tqdm(results, total=len(left), desc=f"preparing {source.name}", unit="shape", disable=quiet)
    return ((left[index], result) for index, result in bar)


def _left(shapes: list[Shape], stored: dict[str, StoredShape]) -> list[Shape]:
    """The shapes that are not in the store as they are now."""

    def is_done(shape: Shape) -> bool:
        kept = stored.get(shape.id)
        return bool(kept and kept.fingerprint == shape.fingerprint and kept.record.reason not in TRIED_AGAIN)

    return [shape for shape in shapes if not is_done(shape)]


def _file(folder: Path, id: str) -> Path:
    check_id(id)
    return folder / f"{id}{SUFFIX}"


def _ids_in(folder: Path) -> list[str]:
    files = (Path(path, name) for path, _, names in os.walk(folder) for name in names)
    paths = (file.relative_to(folder).as_posix() for file in files if file.name.endswith(SUFFIX))
    return sorted(id for path in paths if re.fullmatch(SHAPE_ID, id := path.removesuffix(SUFFIX)))


def _read(
    folder: Path, ids: Iterable[str], up: Literal["y", "z"] = "z", level: int = logging.WARNING
) -> dict[str, StoredShape]:
    """The stored shapes of some ids, in their order, without those that are missing or clearly damaged."""
    paths = {id: _file(folder, id) for id in ids}
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
    folder: Path, shapes: list[Shape], source: Source, level: int = logging.DEBUG
) -> dict[str, StoredShape]:
    """The stored shapes whose files are intact, by id; damage is logged at `level`."""
    stored = _read(folder, [shape.id for shape in shapes], source.up, level)
    known = _index(folder).get("checked", {})
    changed = {id: shape for id, shape in stored.items() if known.get(id) != shape.state}
    with ThreadPoolExecutor() as pool:  # hashing lets other threads run
        intact = dict(zip(changed, pool.map(StoredShape.is_intact, changed.values()), strict=True))
    for id in [id for id, is_intact in intact.items() if not is_intact]:
        log.log(level, "store: %s: damaged (checksum): to be prepared again", stored.pop(id).path)
    _remember(folder, {id: stored[id] for id in changed if id in stored})
    return stored


def _index(folder: Path) -> dict:
    try:
        index = json.loads((folder / INDEX).read_text(encoding="utf-8"))
        return index if isinstance(index["checked"], dict) else {}
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        return {}


def _remember(folder: Path, intact: dict[str, StoredShape], about: dict | None = None) -> None:
    """Notes that files are intact, and for a reader what the store was made of."""
    if intact:
        index = _index(folder)
        states = {id: shape.state for id, shape in intact.items()}
        checked = dict(sorted((index.get("checked", {}) | states).items()))
        index = {"about": about or index.get("about"), "checked": checked}
        with suppress(OSError):  # a store that others own is read all the same
            write_whole(folder / INDEX, json.dumps(index, indent=1))


def _remove_leftovers(folder: Path) -> None:
    """Removes the half-written files of runs that were killed more than an hour ago."""
    for path, _, names in os.walk(folder):
        for leftover in (Path(path, name) for name in names if _LEFTOVER.fullmatch(name)):
            if time.time() - leftover.lstat().st_mtime > 3600:
                leftover.unlink(missing_ok=True)


@contextmanager
def _writing(folder: Path) -> Iterator[None]:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield
    except OSError as error:
        raise SdfhubError(f"{folder}: the store cannot be written: {error}") from error
