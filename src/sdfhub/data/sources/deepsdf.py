"""Samples that DeepSDF's own preprocessing wrote: no meshes needed."""

import io
import math
import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from sdfhub.data.sources.source import (
    Shape,
    Source,
    absolute,
    folder_safe,
    name_of_root,
    plain_categories,
    state_of,
    unique_ids,
)
from sdfhub.data.sources.split_file import with_roles
from sdfhub.errors import RejectedMesh, SdfhubError
from sdfhub.shapes import Frame, ShapeSamples

MAX_BYTES = 1 << 30
"""Of one array; DeepSDF's have some 8 MB."""

HEADER = 1 << 16
"""Bytes in which an array's header must lie; numpy writes 128."""

REACH = 1.5
"""Along an axis: samples lie near shapes in the unit ball, or anywhere in the cube [-1, 1]^3."""

_SAMPLES, _PARAMETERS = "SdfSamples", "NormalizationParameters"


class DeepSdfSource(Source):
    """Every .npz with `pos` and `neg` ([n, 4] rows x, y, z, sdf) below a folder.

    DeepSDF writes `SdfSamples/<dataset>/<class>/<id>.npz`; any tree will do. Where classes are named by a
    synset of `categories`, only those categories are taken; otherwise all files are, and a file's folder
    names its category. The files lie in the normalised frame and carry no surface normals and no mesh;
    `NormalizationParameters/...` beside `SdfSamples` gives the way back to the source's frame.

    Args:
        root: the folder, searched with all below it.
        categories: name -> {synset}, or None.
        train_split: file listing the training shapes, DeepSDF's form; see `split_file.with_roles`.
        test_split: the same for held-out shapes. Where either is given, unlisted shapes are left out.
    """

    has_normals = False
    is_collection = True

    def __init__(
        self,
        root: str,
        categories: Mapping | None = None,
        train_split: str | None = None,
        test_split: str | None = None,
    ):
        self.root = Path(absolute(root))
        self.category_of = by_synset(categories)
        self.train_split, self.test_split = absolute(train_split), absolute(test_split)
        self.name = name_of_root("deepsdf", self.root)
        self._files: dict[str, Path] = {}

    def shapes(self) -> list[Shape]:
        if not self.root.is_dir():
            raise SdfhubError(f"data.source.root={self.root}: no such folder")
        files = [file for file in sorted(self.root.rglob("*.npz")) if _PARAMETERS not in file.parts]
        if not files:
            raise SdfhubError(f"data.source.root={self.root}: holds no .npz files with DeepSDF's samples")
        is_by_synset = any(file.parent.name in self.category_of for file in files)
        files = [file for file in files if not is_by_synset or file.parent.name in self.category_of]
        self._files = unique_ids({file: self._id(file) for file in files}, self.root)
        found = [
            (Shape(id, id.partition("/")[0], _fingerprint(file)), self._path(file))
            for id, file in sorted(self._files.items())
        ]
        return with_roles(found, self.train_split, self.test_split)

    def load(self, shape: Shape) -> ShapeSamples:
        if not self._files:
            self.shapes()
        return read_samples(self._files[shape.id])

    def _path(self, file: Path) -> str:
        return file.relative_to(self.root).with_suffix("").as_posix()

    def _id(self, file: Path) -> str:
        return shape_id(self._path(file), self.category_of, self.root.name)


def by_synset(categories: Mapping | None) -> dict[str, str]:
    """Category of each synset that the settings of categories name."""
    settings = plain_categories(categories) if categories else {}
    return {each["synset"]: name for name, each in settings.items() if each.get("synset")}


def shape_id(path: str, category_of: Mapping[str, str], above: str = "") -> str:
    """The id of the shape whose samples lie at a path such as `ShapeNetV2/03001627/1a2b`, without suffix.

    Args:
        path: below the root.
        category_of: category of each synset.
        above: name of the root.
    """
    *parents, stem = path.split("/")
    folder = "_".join(part for part in parents if part != _SAMPLES) or "folder"
    category = category_of.get(parents[-1] if parents else above, folder)
    return f"{folder_safe(category)}/{folder_safe(stem)}"


def read_samples(path: Path) -> ShapeSamples:
    """The samples in one of DeepSDF's .npz files; rows with a NaN are dropped, as DeepSDF does.

    Raises:
        RejectedMesh: corrupt_file; one_sided_samples where nothing lies outside or nothing inside;
            wrong_frame where points lie beyond REACH.
    """
    positive, negative = _rows(path, "pos"), _rows(path, "neg")
    if not len(positive) or not len(negative):
        what = f"{path}: {len(positive)} samples outside, {len(negative)} inside"
        raise RejectedMesh("one_sided_samples", what)
    rows = np.concatenate([positive, negative])
    if (reach := np.abs(rows[:, :3]).max()) > REACH:
        what = f"{path}: has points {reach:.3g} from 0 along an axis; in the normalised frame all are near 1"
        raise RejectedMesh("wrong_frame", what)
    center, scale = frame_of(path) or (np.zeros(3), 1.0)
    none = np.zeros((0, 3), dtype=np.float32)
    statistics = {"inside": len(negative) / len(rows)}
    return ShapeSamples(
        rows[:, :3].copy(), rows[:, 3].copy(), none, none, Frame(center, scale), None, statistics
    )


def _rows(path: Path, name: str) -> np.ndarray:
    rows = npz_array(path, name)
    if rows.ndim != 2 or rows.shape[1] != 4:
        raise RejectedMesh("corrupt_file", f"{path}: {name} has the shape {list(rows.shape)}, not [n, 4]")
    rows = rows.astype(np.float32)
    return rows[np.isfinite(rows).all(axis=1)]


def frame_of(path: Path) -> tuple[np.ndarray, float] | None:
    """Centre and scale of the source, from DeepSDF's `normalised = (source + offset) * scale`; None: unknown.

    Args:
        path: of the samples, `.../SdfSamples/...npz`, whether or not they are there.

    Raises:
        RejectedMesh: corrupt_file.
    """
    beside = _frame_file(path)
    if beside is None:
        return None
    offset, scale = npz_array(beside, "offset").ravel(), npz_array(beside, "scale").ravel()
    is_finite = bool(np.isfinite([*offset, *scale]).all())
    if offset.shape != (3,) or scale.shape != (1,) or not is_finite or scale[0] <= 0:
        raise RejectedMesh("corrupt_file", f"{beside}: no offset [3] and positive scale")
    return -offset.astype(np.float64), float(scale[0])


def _frame_file(path: Path) -> Path | None:
    beside = Path(*(_PARAMETERS if part == _SAMPLES else part for part in path.parts))
    return beside if _SAMPLES in path.parts and beside.is_file() else None


def _fingerprint(path: Path) -> str:
    beside = _frame_file(path)
    return " ".join(state_of(file) for file in (path, beside) if file)


def npz_array(path: Path, name: str) -> np.ndarray:
    """One floating-point array of an .npz, its size checked before anything is allocated."""
    try:
        with zipfile.ZipFile(path) as archive, archive.open(f"{name}.npy") as file:
            head = io.BytesIO(file.read(HEADER))  # a header may claim gigabytes for itself
            version = np.lib.format.read_magic(head)
            read_header = {(1, 0): np.lib.format.read_array_header_1_0}.get(
                version, np.lib.format.read_array_header_2_0
            )
            shape, is_fortran, dtype = read_header(head)
            size = math.prod(shape) * dtype.itemsize
            if dtype.kind != "f" or min(shape, default=0) < 0 or size > MAX_BYTES:
                raise ValueError(f"{name} is {list(shape)} {dtype}, not some floating-point numbers")
            content = head.read() + file.read(size)  # to its end, where the archive's checksum is compared
            if file.read(1):
                raise ValueError(f"{name} is longer than its header says")
            return np.frombuffer(content, dtype, math.prod(shape)).reshape(
                shape, order="F" if is_fortran else "C"
            )
    except (MemoryError, RecursionError):
        raise
    except Exception as error:  # zip archives and numpy's headers break in many ways
        raise RejectedMesh("corrupt_file", f"{path}: {error}") from error
