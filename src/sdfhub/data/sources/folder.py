"""Any folder of mesh files."""

import hashlib
import json
import os
import re
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Literal

from sdfhub.data.sources.mesh_files import FORMATS, buffer_names, buffer_path
from sdfhub.data.sources.source import Shape, folder_safe, unique_ids
from sdfhub.data.sources.split_file import SourceOfFiles
from sdfhub.errors import SdfhubError
from sdfhub.whole_file import file_sha256


class FolderSource(SourceOfFiles):
    """All mesh files below a folder: .obj .ply .stl .off .glb .gltf .ac.

    Files in the folder itself are of the category `folder`, those below of the category that their first
    folder names. An id is the category and the rest of the path, without the suffix and with `_` for what a
    folder's name may not hold; files that would share an id get some digits of their path's hash.

    Args:
        root: the folder, searched with all below it; hidden files and folders are left out.
        train_split, test_split: see `SourceOfFiles`.
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
        categories: Iterable[str] | None = None,
    ):
        super().__init__("folder", root, train_split, test_split)
        self.up, self.categories = up, [str(name) for name in categories or ()]

    @property
    def label(self) -> str:
        return folder_safe(self.root.resolve().name)

    def listed(self) -> Iterator[tuple[Shape, Path, str]]:
        below = {path: path.relative_to(self.root) for path in self.root.rglob("*")}
        ids = {
            path: _id(part)
            for path, part in below.items()
            if path.suffix.lower() in FORMATS
            and path.is_file()
            and not re.search(r"(^|/)\.", part.as_posix())
        }
        if not ids:
            raise SdfhubError(f"data.source.root={self.root}: holds no mesh files ({' '.join(FORMATS)})")
        there = sorted({id.partition("/")[0] for id in ids.values()})
        if missing := [name for name in self.categories if name not in there]:
            what = f"data.source.root={self.root} has no folder of that name, but {', '.join(there)}"
            raise SdfhubError(f"category={missing[0]}: {what}; without category= all are taken")
        for id, file in sorted(unique_ids(ids, self.root).items()):
            category = id.partition("/")[0]
            if category in (self.categories or there):
                # a name may hold bytes of another encoding, which JSON would not take
                title = os.fsencode(file.name).decode(errors="replace")
                shape = Shape(id, category, _fingerprint(file), credits={"title": title})
                yield shape, file, below[file].with_suffix("").as_posix()


def _id(path: Path) -> str:
    category, *rest = path.with_suffix("").parts if len(path.parts) > 1 else ("folder", path.stem)
    return f"{folder_safe(category)}/{folder_safe('_'.join(rest))}"


def _fingerprint(file: Path) -> str:
    """Hash of a file's content, and of the buffers that a .gltf names."""
    digest = file_sha256(file)
    if file.suffix.lower() == ".gltf":
        with suppress(ValueError, AttributeError, TypeError, RecursionError):  # reading says what is wrong
            buffers = [buffer_path(file.parent, name) for name in buffer_names(json.loads(file.read_bytes()))]
            parts = [digest, *(file_sha256(buffer) for buffer in buffers if buffer)]
            digest = hashlib.sha256("".join(parts).encode()).hexdigest()
    return digest
