"""Any folder of mesh files."""

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from sdfhub.data.sources.mesh_files import FORMATS, buffer_path, read_mesh
from sdfhub.data.sources.source import (
    Shape,
    Source,
    absolute,
    folder_safe,
    name_of_root,
    unique_ids,
)
from sdfhub.data.sources.split_file import with_roles
from sdfhub.errors import SdfhubError
from sdfhub.shapes import Mesh
from sdfhub.whole_file import file_sha256


class FolderSource(Source):
    """All mesh files below a folder: .obj .ply .stl .off .glb .gltf .ac.

    Files in the folder itself are of the category `folder`, those below of the category that their first
    folder names. An id is the category and the rest of the path, without the suffix and with `_` for what a
    folder's name may not hold; files that would share an id get some digits of their path's hash.

    Args:
        root: the folder, searched with all below it; hidden files and folders are left out.
        train_split: file listing the training shapes by path, `{"train": [...], "test": [...]}` or another
            form of `split_file.with_roles`; None lets a seed decide.
        test_split: the same for held-out shapes. Where either is given, unlisted files are left out.
        up: the axis that points up in the files; only pictures are turned by it.
        categories: names of first folders, or a mapping of them; others are left out. None or none: all.
    """

    is_collection = True

    def __init__(
        self,
        root: str,
        train_split: str | None = None,
        test_split: str | None = None,
        up: Literal["y", "z"] = "y",
        categories: Mapping[str, Any] | list[str] | None = None,
    ):
        self.root, self.up = Path(absolute(root)), up
        self.train_split, self.test_split = absolute(train_split), absolute(test_split)
        self.categories = [str(name) for name in categories or ()]
        self.name = name_of_root("folder", self.root)
        self._files: dict[str, Path] = {}

    @property
    def label(self) -> str:
        return folder_safe(self.root.resolve().name)

    def shapes(self) -> list[Shape]:
        if not self.root.is_dir():
            what = "a file, not a folder" if self.root.exists() else "no such folder"
            raise SdfhubError(f"data.source.root={self.root}: {what}; set it to the folder of your meshes")
        self._files = self._by_id()
        if not self._files:
            raise SdfhubError(f"data.source.root={self.root}: holds no mesh files ({' '.join(FORMATS)})")
        there = sorted({_category(id) for id in self._files})
        if missing := [name for name in self.categories if name not in there]:
            raise SdfhubError(
                f"category={missing[0]}: data.source.root={self.root} has no folder of that name, but "
                f"{', '.join(there)}; without category= all are taken"
            )
        found = [
            (Shape(id, _category(id), _fingerprint(file), credits={"title": _shown(file.name)}), path)
            for id, file in sorted(self._files.items())
            if not self.categories or _category(id) in self.categories
            for path in [file.relative_to(self.root).with_suffix("").as_posix()]
        ]
        return with_roles(found, self.train_split, self.test_split)

    def load(self, shape: Shape) -> Mesh:
        if not self._files:
            self._files = self._by_id()
        return read_mesh(self._files[shape.id])

    def _by_id(self) -> dict[str, Path]:
        paths = sorted(path for path in self.root.rglob("*") if path.suffix.lower() in FORMATS)
        paths = [path for path in paths if path.is_file() and not self._is_hidden(path)]
        return unique_ids({path: _id(path.relative_to(self.root)) for path in paths}, self.root)

    def _is_hidden(self, path: Path) -> bool:
        return any(part.startswith(".") for part in path.relative_to(self.root).parts)


def _id(path: Path) -> str:
    category, *rest = path.with_suffix("").parts if len(path.parts) > 1 else ("folder", path.stem)
    return f"{folder_safe(category)}/{folder_safe('_'.join(rest))}"


def _category(id: str) -> str:
    return id.partition("/")[0]


def _shown(name: str) -> str:
    """A file's name as text: it may hold bytes of another encoding, which JSON would not take."""
    return os.fsencode(name).decode(errors="replace")


def _fingerprint(file: Path) -> str:
    """Hash of a file's content, and of the buffers that a .gltf names."""
    digest = file_sha256(file)
    if file.suffix.lower() != ".gltf":
        return digest
    try:
        names = [buffer.get("uri", "") for buffer in json.loads(file.read_bytes()).get("buffers", [])]
        buffers = [buffer_path(file.parent, name) for name in names if not name.startswith("data:")]
    except (ValueError, AttributeError, TypeError, RecursionError):
        return digest  # reading it will say what is wrong
    return hashlib.sha256("".join([digest, *(file_sha256(b) for b in buffers if b)]).encode()).hexdigest()
