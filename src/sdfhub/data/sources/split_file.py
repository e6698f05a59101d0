"""Split files: which shapes somebody else trained and tested on."""

import json
import logging
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import chain
from pathlib import Path

from sdfhub.data.sources.source import Role, Shape
from sdfhub.errors import SdfhubError

log = logging.getLogger(__name__)


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
    names, of_path, of_ending = sorted(set(names_listed(file, role))), defaultdict(list), defaultdict(list)
    for shape, path in shapes:
        of_path[path].append(shape.id)
        for ending in _endings(path):
            of_ending[ending].append(shape.id)
    ids = {}  # a name that is a path means that file alone; others are the last parts of one, or end in one
    for name in names:
        longer, shorter = of_ending.get(name, []), (of_path.get(end, []) for end in _endings(name))
        ids[name] = of_path.get(name) or [*longer, *chain.from_iterable(shorter)]
    listed = set(chain.from_iterable(ids.values()))
    if not listed:
        raise SdfhubError(f"{file}: none of the {len(names)} {role} shapes it lists is there")
    if lost := [name for name in names if not ids[name]]:
        what = f"{len(lost)} of the {len(names)} {role} shapes it lists are not there"
        log.warning(f"{file}: {what}, such as {lost[0]}")
    return listed


def names_listed(file: str, role: Role) -> Iterator[str]:
    """The names that a split file lists for a role, in its order; nested keys become parts of a path."""
    try:
        content = json.loads(Path(file).read_text())
    except OSError as error:
        raise SdfhubError(f"{file}: the {role} split cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise SdfhubError(f"{file}: not JSON: {error}") from error
    if isinstance(content, dict) and content and content.keys() <= {"train", "held_out", "test"}:
        content = content.get(role, content.get("test", []) if role == "held_out" else [])
    try:
        yield from _flattened(content)
    except TypeError as error:
        forms = '{"dataset": {"class": [ids]}}, [names] or {"train": [names], "test": [names]}'
        raise SdfhubError(f"{file}: expected {forms}") from error


def _flattened(content: object, prefix: str = "") -> Iterator[str]:
    if isinstance(content, dict):
        for key, value in content.items():
            yield from _flattened(value, f"{prefix}{key}/")
    elif isinstance(content, list) and all(isinstance(name, str) for name in content):
        yield from (prefix + name for name in content)
    else:
        raise TypeError("neither a mapping nor a list of names")


def _endings(path: str) -> Iterable[str]:
    parts = path.split("/")
    return ("/".join(parts[start:]) for start in range(len(parts)))
