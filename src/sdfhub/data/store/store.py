"""The store of prepared shapes: samples are made once and mapped into memory ever after.

    root / source name / hash of the preparation / manifest.json
                                                 / shape id / shape.json, outside.npy, inside.npy, ...

Each shape's folder is written beside its place and renamed. The manifest is an index of their records:
a start with a thousand shapes reads one file. What the manifest lacks (a run was killed before it wrote
it) is taken over from the folders.
"""

import dataclasses
import hashlib
import json
import os
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

from tqdm import tqdm

from sdfhub.data.preparation.sampling import Preparation, prepare_mesh
from sdfhub.data.sources.source import Shape, Source
from sdfhub.data.store import shards
from sdfhub.data.store.comparison import damaged_shapes, remember
from sdfhub.data.store.manifest import MANIFEST, VERSION, enter, new_manifest, read_manifest, write_manifest
from sdfhub.data.store.shards import StoredShape
from sdfhub.data.workers import Crashed, map_in_processes
from sdfhub.errors import RejectedMesh, SdfhubError
from sdfhub.locks import locked
from sdfhub.shapes import ShapeSamples

PASSING = ("error", "crash")
"""Reasons that lie in the machine or the program rather than the mesh: such shapes are tried again."""


class Store:
    """Prepared shapes of one source under one preparation.

    Args:
        folder: where `manifest.json` lies.
        manifest: its content.
        ids: the shapes wanted of it; rejected ones are left out of `ids` and listed in `rejected`.
        up: the axis that points up in the source's frame, for pictures.
    """

    def __init__(self, folder: Path, manifest: dict, ids: list[str], up: Literal["y", "z"] = "z"):
        self.folder = folder
        records, rejected = manifest["shapes"], manifest["rejected"]
        missing = [id for id in ids if id not in records and id not in rejected]
        if missing:
            raise SdfhubError(f"{folder}: shape {missing[0]} has not been prepared; run `sdfhub prepare`")
        self.rejected: dict[str, dict] = {id: rejected[id] for id in ids if id in rejected}
        self._shapes = {id: StoredShape(id, folder / id, records[id], up) for id in ids if id in records}

    @classmethod
    def open(cls, root: str | Path, ids: list[str] | None = None) -> "Store":
        """The store whose manifest lies in `root`, limited to `ids`; None takes all it has.

        Raises:
            SdfhubError: no readable manifest there, or a shape that was never prepared.
        """
        manifest = read_manifest(Path(root))
        if manifest is None:
            raise SdfhubError(f"{root}: holds no {MANIFEST} of version {VERSION}; run `sdfhub prepare` first")
        everything = sorted(manifest["shapes"] | manifest["rejected"])
        return cls(Path(root), manifest, everything if ids is None else list(ids))

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
            raise SdfhubError(f"shape {id} was rejected: {self.rejected[id]['reason']}")
        if id not in self._shapes:
            raise SdfhubError(f"shape {id} is not among the {len(self)} shapes opened from {self.folder}")
        return self._shapes[id]

    def summary(self) -> str:
        """Kept, rejected by reason, seconds a shape: lines for a reader."""
        reasons = Counter(entry["reason"] for entry in self.rejected.values())
        seconds = sum(shape.seconds for shape in self) / max(1, len(self))
        kept = f"{len(self)} shapes kept, {len(self.rejected)} rejected"
        lines = [f"{kept}; preparing took {seconds:.2f} s a shape"]
        for reason, count in reasons.most_common():
            id, entry = next((id, e) for id, e in self.rejected.items() if e["reason"] == reason)
            lines.append(f"  rejected {count} x {reason}, such as {id} ({entry['detail']})")
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

    A shape is prepared again when its fingerprint, the preparation or VERSION changes, or its files are no
    longer those that were written: checksums are compared where a size or date has changed. Its randomness
    derives from its id and fingerprint, so neither the order nor the number of workers matters.

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
    manifest = read_manifest(folder) or new_manifest(source.name, preparation)
    damaged = damaged_shapes(_records(shapes, manifest), folder)
    if damaged or _missing(shapes, manifest):
        try:
            with _locked(folder):
                manifest = _fill(source, shapes, preparation, folder, workers, progress, damaged)
        except OSError as error:
            raise SdfhubError(f"{folder}: the store cannot be written: {error}") from error
    store = Store(folder, manifest, [shape.id for shape in shapes], source.up)
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

    Only the shapes' folders are written: the next call of `prepare` takes them over into the manifest, which
    costs no more than reading their records.

    Args:
        shapes: this part's own; the other arguments are those of `prepare`.

    Returns:
        How many were prepared or rejected; the others were there, or are left to the next call, since
        their worker died.

    Raises:
        SdfhubError: the store cannot be written.
    """
    folder = Path(root) / source.name / preparation_hash(preparation)
    try:
        with _locked(folder, shared=True):
            _refuse_detours(shapes, folder)
            manifest = read_manifest(folder) or new_manifest(source.name, preparation)
            left = _left_after_folders(shapes, manifest, folder)
            results = _results(source, left, preparation, folder, workers, progress)
            return sum(not isinstance(record, Crashed) for _, record in results)
    except OSError as error:
        raise SdfhubError(f"{folder}: the store cannot be written: {error}") from error


def preparation_hash(preparation: Preparation) -> str:
    """12 hex digits that change with every setting of the preparation and with VERSION."""
    settings = json.dumps([VERSION, dataclasses.asdict(preparation)], sort_keys=True)
    return hashlib.sha256(settings.encode()).hexdigest()[:12]


def shape_seed(shape: Shape | StoredShape) -> int:
    """The seed of a shape's samples: 63 bits of a hash of its id and fingerprint."""
    digest = hashlib.sha256(f"{shape.id}\n{shape.fingerprint}".encode()).digest()
    return int.from_bytes(digest[:8], "big") >> 1


def prepare_shape(source: Source, shape: Shape, preparation: Preparation, folder: Path) -> dict:
    """Loads, samples and writes one shape; returns its record. Never raises for a bad mesh.

    Raises:
        OSError: the store cannot be written, which no other shape would survive either.
    """
    start = time.perf_counter()
    record = {"fingerprint": shape.fingerprint, "category": shape.category, "credits": shape.credits}
    try:
        loaded = source.load(shape)
        is_sampled = isinstance(loaded, ShapeSamples)
        samples = loaded if is_sampled else prepare_mesh(loaded, preparation, shape_seed(shape))
        arrays = shards.arrays_of(samples, shape_seed(shape))
    except RejectedMesh as rejection:
        arrays, refusal = {}, {"reason": rejection.reason, "detail": rejection.detail}
    except Exception as error:  # whatever a strange mesh provokes, the other shapes go on
        arrays, refusal = {}, {"reason": "error", "detail": f"{type(error).__name__}: {error}"}
    else:
        refusal = None
        record |= {"center": samples.center.tolist(), "scale": float(samples.scale)}
        record |= {"statistics": {name: float(value) for name, value in samples.statistics.items()}}
    record |= {"rejected": refusal, "seconds": round(time.perf_counter() - start, 4)}
    return shards.write_shape(folder / shape.id, arrays, record)


@dataclasses.dataclass(frozen=True)
class _PrepareShape:
    """`prepare_shape` with all but the shape filled in; pickles into worker processes."""

    source: Source
    preparation: Preparation
    folder: Path

    def __call__(self, shape: Shape) -> dict:
        return prepare_shape(self.source, shape, self.preparation, self.folder)


def _fill(source, shapes, preparation, folder, workers, progress, damaged) -> dict:
    _refuse_detours(shapes, folder)
    shards.remove_leftovers(folder)
    manifest = read_manifest(folder) or new_manifest(source.name, preparation)
    for id in damaged:
        manifest["shapes"].pop(id, None)
    left = _left_after_folders(shapes, manifest, folder)
    try:
        for index, record in _results(source, left, preparation, folder, workers, progress):
            is_crash = isinstance(record, Crashed)
            enter(manifest, left[index].id, _crash_record(left[index]) if is_crash else record)
    finally:  # a run that is interrupted keeps what it has
        write_manifest(folder, manifest)
    remember(_records(shapes, manifest), folder)
    return manifest


def _records(shapes: list[Shape], manifest: dict) -> dict[str, dict]:
    """What the manifest says of those shapes that it keeps, by id."""
    kept = manifest["shapes"]
    return {shape.id: kept[shape.id] for shape in shapes if shape.id in kept}


def _left_after_folders(shapes: list[Shape], manifest: dict, folder: Path) -> list[Shape]:
    """The shapes that neither the manifest nor a folder holds; what folders hold enters the manifest."""
    for shape in _missing(shapes, manifest):
        record = shards.read_record(folder / shape.id)
        if record:
            enter(manifest, shape.id, record)
    return _missing(shapes, manifest)


def _results(source, left, preparation, folder, workers, progress) -> Iterator[tuple[int, dict | Crashed]]:
    workers = max(1, min(workers or os.cpu_count() or 1, len(left)))
    function = _PrepareShape(source, preparation, folder)
    if workers == 1:
        results = ((index, function(shape)) for index, shape in enumerate(left))
    else:
        results = map_in_processes(function, left, workers)
    quiet = None if progress else True  # None: no bar where nobody watches
    return iter(tqdm(results, total=len(left), desc=f"preparing {source.name}", unit="shape", disable=quiet))


def _crash_record(shape: Shape) -> dict:
    detail = "the worker process died: out of memory, or a fault in a native library"
    refusal = {"reason": "crash", "detail": detail}
    return {"fingerprint": shape.fingerprint, "category": shape.category, "rejected": refusal}


def _refuse_detours(shapes: list[Shape], folder: Path) -> None:
    for parent in {(folder / shape.id).parent for shape in shapes}:
        if not parent.resolve().is_relative_to(folder.resolve()):
            raise SdfhubError(f"{parent}: leads out of the store; remove that link")


def _missing(shapes: list[Shape], manifest: dict) -> list[Shape]:
    """The shapes without a valid entry in the manifest."""

    def is_done(shape: Shape) -> bool:
        refusal = manifest["rejected"].get(shape.id)
        entry = refusal or manifest["shapes"].get(shape.id)
        is_passing = refusal is not None and refusal["reason"] in PASSING
        return entry is not None and entry["fingerprint"] == shape.fingerprint and not is_passing

    return [shape for shape in shapes if not is_done(shape)]


@contextmanager
def _locked(folder: Path, shared: bool = False) -> Iterator[None]:
    """Lets one process at a time fill a store, or several that prepare parts of it (`shared`)."""
    folder.mkdir(parents=True, exist_ok=True)
    waiting = f"store: {folder}: waiting for another process that prepares it"
    with locked(folder / ".lock", shared=shared, waiting=waiting):
        yield
