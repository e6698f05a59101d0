"""Samples that DeepSDF's own preprocessing wrote: no meshes needed."""

import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from sdfhub.data.sources.folder import SourceOfFiles
from sdfhub.data.sources.source import Shape, folder_safe, unique_ids
from sdfhub.errors import RejectedMesh, SdfhubError
from sdfhub.shapes import NORMALIZED, Frame, ShapeSamples

MAX_BYTES = 1 << 30  # of one array; DeepSDF's have some 8 MB
REACH = 1.5  # along an axis: samples lie near shapes in the unit ball, or in the cube [-1, 1]^3
_SAMPLES, _PARAMETERS = "SdfSamples", "NormalizationParameters"


def by_synset(categories: Mapping | None) -> dict[str, str]:
    """Category of each synset that the settings of categories name."""
    return {value["synset"]: name for name, value in (categories or {}).items() if value.get("synset")}


def shape_id(path: str, category_of: Mapping[str, str], above: str = "") -> str:
    """The id of the samples at a path such as `ShapeNetV2/03001627/1a2b` below a root called `above`."""
    *parents, stem = path.split("/")
    folder = "_".join(part for part in parents if part != _SAMPLES) or "folder"
    category = category_of.get(parents[-1] if parents else above, folder)
    return f"{folder_safe(category)}/{folder_safe(stem)}"


def read_samples(path: Path) -> ShapeSamples:
    """The samples in one of DeepSDF's .npz files; rows with a NaN are dropped, as DeepSDF does."""
    parts = []
    for name in ("pos", "neg"):
        rows = npz_array(path, name)
        if rows.ndim != 2 or rows.shape[1] != 4:
            raise RejectedMesh("corrupt_file", f"{path}: {name} is {list(rows.shape)}, not [n, 4]")
        rows = rows.astype(np.float32)
        parts.append(rows[np.isfinite(rows).all(axis=1)])
    outside, inside = map(len, parts)
    if not outside or not inside:
        raise RejectedMesh("one_sided_samples", f"{path}: {outside} samples outside, {inside} inside")
    rows = np.concatenate(parts)
    if (reach := np.abs(rows[:, :3]).max()) > REACH:
        raise RejectedMesh("wrong_frame", f"{path}: has points {reach:.3g} from 0 along an axis, not near 1")
    none, frame = np.zeros((0, 3), dtype=np.float32), frame_of(path) or NORMALIZED
    share = {"inside": inside / len(rows)}
    return ShapeSamples(rows[:, :3].copy(), rows[:, 3].copy(), none, none, frame, None, share)


def frame_of(path: Path) -> Frame | None:
    """The frame of samples at `.../SdfSamples/...npz`, there or not; None: unknown.

    Source: DeepSDF's code, `normalised = (source + offset) * scale`.
    """
    if not (beside := _frame_file(path)):
        return None
    try:
        (scale,) = npz_array(beside, "scale").ravel()
        return Frame(-npz_array(beside, "offset").ravel().astype(np.float64), float(scale))
    except ValueError as error:
        raise RejectedMesh("corrupt_file", f"{beside}: no offset [3] and positive scale") from error


def _frame_file(path: Path) -> Path | None:
    beside = Path(*(_PARAMETERS if part == _SAMPLES else part for part in path.parts))
    return beside if _SAMPLES in path.parts and beside.is_file() else None


def npz_array(path: Path, name: str) -> np.ndarray:
    """One floating-point array of an .npz, its size checked before anything is allocated."""
    try:
        with zipfile.ZipFile(path) as archive, archive.open(f"{name}.npy") as file:
            if np.lib.format.read_magic(file) != (1, 0):  # other headers may claim gigabytes for themselves
                raise ValueError(f"{name} is not in numpy's format 1.0")
            shape, is_fortran, dtype = np.lib.format.read_array_header_1_0(file)
            content = file.read(MAX_BYTES)
            if dtype.kind != "f" or file.read(1):  # at its end the archive's checksum is compared
                raise ValueError(f"{name} is {list(shape)} {dtype}, not some floating-point numbers")
            return np.frombuffer(content, dtype).reshape(shape, order="F" if is_fortran else "C")
    except (MemoryError, RecursionError):
        raise
    except Exception as error:  # zip archives and numpy's headers break in many ways
        raise RejectedMesh("corrupt_file", f"{path}: {error}") from error


class DeepSdfSource(SourceOfFiles):
    """Every .npz with `pos` and `neg` ([n, 4] rows x, y, z, sdf) below a folder.

    DeepSDF writes `SdfSamples/<dataset>/<class>/<id>.npz`; any tree will do. Where classes are named by a
    synset of `categories`, only those categories are taken; otherwise all files are, and a file's folder
    names its category. The files lie in the normalised frame and carry no surface normals and no mesh;
    `NormalizationParameters/...` beside `SdfSamples` gives the way back to the source's frame.

    Args:
        root: the folder, searched with all below it.
        categories: name -> {synset}, or None.
        train_split, test_split: see `SourceOfFiles`.
    """

    read = staticmethod(read_samples)
    has_normals = False
    is_collection = True

    def __init__(
        self,
        root: str,
        categories: Mapping | None = None,
        train_split: str | None = None,
        test_split: str | None = None,
    ):
        super().__init__("deepsdf", root, train_split, test_split)
        self.category_of = by_synset(categories)

    def listed(self) -> Iterator[tuple[Shape, Path, str]]:
        files = [file for file in sorted(self.root.rglob("*.npz")) if _PARAMETERS not in file.parts]
        if not files:
            raise SdfhubError(f"data.source.root={self.root}: holds no .npz files with DeepSDF's samples")
        files = [file for file in files if file.parent.name in self.category_of] or files
        paths = {file: file.relative_to(self.root).with_suffix("").as_posix() for file in files}
        ids = {file: shape_id(path, self.category_of, self.root.name) for file, path in paths.items()}
        for id, file in sorted(unique_ids(ids, self.root).items()):
            states = [part.stat() for part in (file, _frame_file(file)) if part]
            fingerprint = " ".join(f"{state.st_size} {state.st_mtime_ns}" for state in states)
            yield Shape(id, id.partition("/")[0], fingerprint), file, paths[file]
