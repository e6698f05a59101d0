"""What every data source offers: a list of shapes, and the mesh or the samples of one of them."""

import hashlib
import os
import re
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from sdfhub.errors import SdfhubError
from sdfhub.shapes import Mesh, ShapeSamples, check_id


@dataclass(frozen=True)
class Shape:
    """One shape of a source, before anything of it is loaded.

    Args:
        id: unique within the source and safe as a folder's path, such as `chairs/0007`.
        category: such as `chairs`; splits draw evenly over categories.
        fingerprint: changes when the shape changes (hash of the file, or generator version and index).
        split: the role that a split file gives, or None.
        credits: author, licence, title, as far as known.
    """

    id: str
    category: str
    fingerprint: str
    split: Literal["train", "held_out"] | None = None
    credits: dict[str, str] = field(default_factory=dict)

    def __post_init__(self):
        check_id(self.id)


class Source(ABC):
    """Where shapes come from. Sources pickle: worker processes load through them.

    Attributes:
        name: folder-safe; the store keeps one folder per name, so it tells two roots apart.
        up: the axis that points up in the source's frame; only pictures are turned by it.
        has_normals: whether its shapes come with surface normals.
        is_collection: whether it has what it has, so that numbers of shapes asked for are upper bounds.
    """

    name: str
    up: Literal["y", "z"] = "y"
    has_normals = True
    is_collection = False

    @property
    def label(self) -> str:
        """What runs and tables may call its shapes."""
        return self.name

    @abstractmethod
    def shapes(self) -> list[Shape]:
        """All shapes on offer, sorted by id, the same in every process.

        Raises:
            SdfhubError: the source's root is not there or holds no shape.
        """

    @abstractmethod
    def load(self, shape: Shape) -> Mesh | ShapeSamples:
        """The mesh of one shape in its source's frame, or its samples where the source holds no mesh.

        Raises:
            RejectedMesh: the file holds no usable mesh.
        """


def plain_categories(categories: Mapping) -> dict[str, dict]:
    """`categories` as plain dicts, so that a source pickles whatever mapping it was given.

    Raises:
        SdfhubError: a category is not a mapping.
    """
    if not isinstance(categories, Mapping) or not categories:
        raise SdfhubError(f"category: expected at least one category with its settings, got {categories!r}")
    wrong = [name for name, settings in categories.items() if not isinstance(settings, Mapping)]
    if wrong:
        raise SdfhubError(f"category.{wrong[0]}: expected a mapping (synset, catalogue, aircraft)")
    return {str(name): _plain(settings) for name, settings in categories.items()}


def _plain(value):
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    return value


def folder_safe(text: str) -> str:
    """`text` with everything that a shape's id may not hold replaced by `_`."""
    safe = re.sub(r"[^A-Za-z0-9_.+-]+", "_", text).lstrip("._+-")
    return safe[:100] or "unnamed"


def unique_ids(wanted: Mapping[Path, str], root: Path | None = None) -> dict[str, Path]:
    """Path of each id; paths that want the same id get some digits of their hash behind it.

    Args:
        wanted: id by path.
        root: what the paths lie below, however it is spelled: the same files then have the same ids.
    """
    uses = Counter(wanted.values())
    below = {path: path.relative_to(root) if root else path for path in wanted}
    return {
        id if uses[id] == 1 else f"{id}-{_digits(below[path])}": path for path, id in sorted(wanted.items())
    }


def _digits(path: Path) -> str:
    return hashlib.sha256(os.fsencode(path.as_posix())).hexdigest()[:6]


def name_of_root(kind: str, root: Path) -> str:
    """A source's name that tells two roots apart, such as `folder-scans-1a2b3c`."""
    return f"{kind}-{folder_safe(root.resolve().name)}-{_digits(root.resolve())}"


def absolute(path: str | None) -> str | None:
    """A path that means the same from any folder; None stays None."""
    return None if path is None else os.path.abspath(path)


def state_of(file: Path) -> str:
    """A fingerprint from a file's size and date, for trees too large to be read at every start."""
    state = file.stat()
    return f"{state.st_size} {state.st_mtime_ns}"
