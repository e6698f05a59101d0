"""What every data source offers: a list of shapes, and the mesh or the samples of one of them."""

import hashlib
import os
import re
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar

from pydantic import TypeAdapter, ValidationError

from sdfhub.errors import SdfhubError
from sdfhub.shapes import Mesh, ShapeSamples, check_id

Role = Literal["train", "held_out"]
Settings = TypeVar("Settings")


@dataclass(frozen=True)
class Shape:
    """One shape of a source, before anything of it is loaded."""

    id: str  # unique within the source and safe as a folder's path, such as `chairs/0007`
    category: str  # such as `chairs`; splits draw evenly over categories
    fingerprint: str  # changes when the shape changes (hash of the file, or generator version and index)
    split: Role | None = None  # as a split file says
    credits: dict[str, str] = field(default_factory=dict)  # author, licence, title, as far as known

    def __post_init__(self) -> None:
        check_id(self.id)


class Source(ABC):
    """Where shapes come from. Sources pickle: worker processes load through them."""

    name: str  # folder-safe; the store keeps one folder per name, so it tells two roots apart
    up: Literal["y", "z"] = "y"  # in the source's frame; only pictures are turned by it
    has_normals = True  # whether its shapes come with surface normals
    is_collection = False  # whether it has what it has: numbers of shapes asked for are upper bounds

    @property
    def label(self) -> str:
        """What runs and tables may call its shapes."""
        return self.name

    @abstractmethod
    def shapes(self) -> list[Shape]:
        """All shapes on offer, sorted by id, the same in every process; SdfhubError where there is none."""

    @abstractmethod
    def load(self, shape: Shape) -> Mesh | ShapeSamples:
        """The mesh of one shape in its source's frame, or its samples where the source holds no mesh.

        Raises:
            RejectedMesh: the file holds no usable mesh.
        """


def checked_categories(categories: Any, settings: type[Settings]) -> dict[str, Settings]:
    """The settings of each category, checked; raises SdfhubError with the key of what is wrong."""
    try:
        return TypeAdapter(dict[str, settings]).validate_python(categories)  # type: ignore[valid-type]
    except ValidationError as error:
        problem = error.errors()[0]
        key = ".".join(map(str, ("category", *problem["loc"])))
        raise SdfhubError(f"{key}={problem['input']}: {problem['msg']}") from error


def folder_safe(text: str) -> str:
    """`text` with everything that a shape's id may not hold replaced by `_`."""
    safe = re.sub(r"[^A-Za-z0-9_.+-]+", "_", text).lstrip("._+-")
    return safe[:100] or "unnamed"


def unique_ids(wanted: Mapping[Path, str], root: Path | None = None) -> dict[str, Path]:
    """Path of each id; paths that want the same id get some digits of their hash, below `root`, behind it."""
    uses, unique = Counter(wanted.values()), {}
    for path, id in sorted(wanted.items()):
        unique[id if uses[id] == 1 else f"{id}-{digits(path.relative_to(root or ''))}"] = path
    return unique


def digits(path: Path) -> str:
    """6 hex digits that tell paths apart."""
    return hashlib.sha256(os.fsencode(path.as_posix())).hexdigest()[:6]
