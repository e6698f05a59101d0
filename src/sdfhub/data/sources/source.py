"""What every data source offers: a list of shapes, and the mesh or the samples of one of them."""

import hashlib
import json
import logging
import os
import re
from abc import ABC, abstractmethod
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Literal

from sdfhub.errors import SdfhubError
from sdfhub.shapes import Mesh, ShapeSamples, check_id

log = logging.getLogger(__name__)

Role = Literal["train", "held_out"]


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

    @abstractmethod
    def shapes(self) -> list[Shape]:
        """All shapes on offer, sorted by id, the same in every process; SdfhubError where there is none."""

    @abstractmethod
    def load(self, shape: Shape) -> Mesh | ShapeSamples:
        """The mesh of one shape in its source's frame, or its samples; RejectedMesh where there is none."""


def folder_safe(text: str) -> str:
    """`text` with everything that a shape's id may not hold replaced by `_`."""
    return re.sub(r"[^A-Za-z0-9_.+-]+", "_", text).lstrip("._+-")[:100] or "unnamed"


def unique_ids(wanted: Mapping[Path, str], root: Path | None = None) -> dict[str, Path]:
    """Path of each id; paths that want the same id get some digits of their hash, below `root`, behind it."""
    uses, unique = Counter(wanted.values()), {}
    for path, id in sorted(wanted.items()):
        unique[id if uses[id] == 1 else f"{id}-{digits(path.relative_to(root or ''))}"] = path
    return unique


def digits(path: Path) -> str:
    """6 hex digits that tell paths apart."""
    return hashlib.sha256(os.fsencode(path.as_posix())).hexdigest()[:6]


def with_roles(
    shapes: list[tuple[Shape, str]], train_split: str | None, test_split: str | None
) -> list[Shape]:
    """The shapes that split files list, with their roles; all of them, without roles, where no file is given.

    A split file is JSON in one of three forms: DeepSDF's `{"ShapeNetV2": {"03001627": ["id", ...]}}`, a list
    of names, or `{"train": [names], "held_out": [names]}` (or `test`), which may be given for both sides. A
    name is the path of a file below the root, as beside each shape, or its last parts, without suffix.
    """
    if not train_split and not test_split:
        return [shape for shape, _ in shapes]
    role_of: dict[str, Role] = {}
    files: dict[Role, str | None] = {"train": train_split, "held_out": test_split}
    for role, file in files.items():
        listed = _ids_listed(shapes, file, role) if file else set()
        if both := sorted(listed & role_of.keys()):
            raise SdfhubError(f"{file}: {both[0]} is in the training split as well")
        role_of |= dict.fromkeys(listed, role)
    return [replace(shape, split=role_of[shape.id]) for shape, _ in shapes if shape.id in role_of]


def _ids_listed(shapes: list[tuple[Shape, str]], file: str, role: Role) -> set[str]:
    of_path, of_ending = defaultdict[str, list[str]](list), defaultdict[str, list[str]](list)
    for shape, path in shapes:
        of_path[path].append(shape.id)
        for ending in _endings(path):
            of_ending[ending].append(shape.id)
    ids = {}  # a name that is a path means that file alone; others are the last parts of one, or end in one
    for name in sorted(set(names_listed(file, role))):
        shorter = (id for end in _endings(name) for id in of_path.get(end, []))
        ids[name] = of_path.get(name) or [*of_ending.get(name, []), *shorter]
    if not any(ids.values()):
        raise SdfhubError(f"{file}: none of the {len(ids)} {role} shapes it lists is there")
    if lost := [name for name in ids if not ids[name]]:
        what = f"{len(lost)} of the {len(ids)} {role} shapes it lists are not there"
        log.warning(f"{file}: {what}, such as {lost[0]}")
    return set(chain.from_iterable(ids.values()))


def names_listed(file: str, role: Role) -> Iterator[str]:
    """The names that a split file lists for a role, in its order; nested keys become parts of a path."""
    try:
        content = json.loads(Path(file).read_text())
    except (OSError, ValueError) as error:
        raise SdfhubError(f"{file}: not JSON that can be read: {error}") from error
    if isinstance(content, dict) and content and content.keys() <= {"train", "held_out", "test"}:
        content = content.get(role, content.get("test", []) if role == "held_out" else [])
    yield from _flattened(content, "", file)


def _flattened(content: object, prefix: str, file: str) -> Iterator[str]:
    if isinstance(content, dict):
        for key, value in content.items():
            yield from _flattened(value, f"{prefix}{key}/", file)
    elif isinstance(content, list) and all(isinstance(name, str) for name in content):
        yield from (prefix + name for name in content)
    else:
        forms = '{"dataset": {"class": [ids]}}, [names] or {"train": [names], "test": [names]}'
        raise SdfhubError(f"{file}: expected {forms}")


def _endings(path: str) -> Iterable[str]:
    parts = path.split("/")
    return ("/".join(parts[start:]) for start in range(len(parts)))
