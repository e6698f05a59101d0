"""Folders of mesh files: any folder, and ShapeNet's."""

import hashlib
import json
import os
import re
from abc import abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, StringConstraints

from sdfhub.data.sources import source as sources
from sdfhub.data.sources.mesh_files import FORMATS, buffer_names, buffer_path, read_mesh
from sdfhub.data.sources.source import Shape, Source, folder_safe
from sdfhub.described import check
from sdfhub.errors import SdfhubError
from sdfhub.shapes import Mesh, ShapeSamples
from sdfhub.whole_file import file_sha256

LAYOUTS = ("models/model_normalized.obj", "model.obj")  # of a ShapeNet model's mesh: version 2, version 1


class SourceOfFiles(Source):
    """A source of one file per shape below a root, named for `kind` and its root.

    `train_split` and `test_split` are files that list the training and the held-out shapes; see `with_roles`.
    Where either is given, unlisted shapes are left out. None lets a seed decide.
    """

    read: Callable[[Path], Mesh | ShapeSamples] = staticmethod(read_mesh)  # what a shape's file holds

    def __init__(self, kind: str, root: str, train_split: str | None = None, test_split: str | None = None):
        self.root = Path(os.path.abspath(root))
        self.train_split = train_split and os.path.abspath(train_split)
        self.test_split = test_split and os.path.abspath(test_split)
        self.name = f"{kind}-{folder_safe(self.root.resolve().name)}-{sources.digits(self.root.resolve())}"
        self._files: dict[str, Path] = {}

    @abstractmethod
    def listed(self) -> Iterator[tuple[Shape, Path, str]]:
        """Each shape by id with its file, and its path below the root as split files have it."""

    def shapes(self) -> list[Shape]:
        if not self.root.is_dir():
            what = "a file, not a folder" if self.root.exists() else "no such folder"
            raise SdfhubError(f"data.source.root={self.root}: {what}; set it to the folder of your shapes")
        listed = list(self.listed())
        self._files = {shape.id: file for shape, file, _ in listed}
        return sources.with_roles([(s, path) for s, _, path in listed], self.train_split, self.test_split)

    def load(self, shape: Shape) -> Mesh | ShapeSamples:
        if not self._files:
            self.shapes()
        return self.read(self._files[shape.id])


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

    def listed(self) -> Iterator[tuple[Shape, Path, str]]:
        below = {path: path.relative_to(self.root).with_suffix("") for path in self.root.rglob("*")}
        meshes = (path for path in below if path.suffix.lower() in FORMATS and path.is_file())
        ids = {path: _id(below[path]) for path in meshes if not re.search(r"(^|/)\.", str(below[path]))}
        if not ids:
            raise SdfhubError(f"data.source.root={self.root}: holds no mesh files ({' '.join(FORMATS)})")
        there = sorted({id.partition("/")[0] for id in ids.values()})
        if missing := [name for name in self.categories if name not in there]:
            what = f"data.source.root={self.root} has no folder of that name, but {', '.join(there)}"
            raise SdfhubError(f"category={missing[0]}: {what}; without category= all are taken")
        for id, file in sorted(sources.unique_ids(ids, self.root).items()):
            category = id.partition("/")[0]
            if category in (self.categories or there):
                yield Shape(id, category, _fingerprint(file)), file, below[file].as_posix()


def _id(path: Path) -> str:
    category, *rest = path.parts if len(path.parts) > 1 else ("folder", path.name)
    return f"{folder_safe(category)}/{folder_safe('_'.join(rest))}"


def _fingerprint(file: Path) -> str:
    """Hash of a file's content, and of the buffers that a .gltf names."""
    digest = file_sha256(file)
    if file.suffix.lower() == ".gltf":
        with suppress(ValueError, AttributeError, TypeError, RecursionError):  # reading says what is wrong
            buffers = [buffer_path(file.parent, name) for name in buffer_names(json.loads(file.read_bytes()))]
            parts = "".join(file_sha256(buffer) for buffer in buffers if buffer)
            digest = hashlib.sha256((digest + parts).encode()).hexdigest()
    return digest


class Category(BaseModel):
    """A category's settings: ShapeNet's number of it, a quoted string of digits."""

    synset: Annotated[str, StringConstraints(pattern=r"^\d+$")]


class ShapeNetSource(SourceOfFiles):
    """ShapeNetCore as it unpacks: models `<root>/<synset>/<model>/`, their meshes as in version 1 or 2.

    A model is known by its file's size and date: hashing ShapeNet at every start takes minutes.

    Args:
        categories: name -> {synset}.
        root: the folder that holds the synsets' folders.
        train_split, test_split: see `SourceOfFiles`.
    """

    def __init__(
        self, categories: Mapping, root: str, train_split: str | None = None, test_split: str | None = None
    ):
        super().__init__("shapenet", root, train_split, test_split)
        self.categories = sorted(check(categories, dict[str, Category], "category").items())

    def listed(self) -> Iterator[tuple[Shape, Path, str]]:
        for category, settings in self.categories:
            folder = self.root / settings.synset
            places = [model / layout for model in sorted(folder.glob("*")) for layout in LAYOUTS]
            files = {file.relative_to(folder).parts[0]: file for file in reversed(places) if file.is_file()}
            if not files:
                raise SdfhubError(f"{folder}: holds no <model>/{LAYOUTS[0]} or <model>/{LAYOUTS[1]}")
            for model, file in sorted(files.items()):
                credits = {"author": "ShapeNet", "licence": "ShapeNet terms of use", "title": model}
                id, state = f"{category}/{folder_safe(model)}", file.stat()
                shape = Shape(id, category, f"{state.st_size} {state.st_mtime_ns}", credits=credits)
                yield shape, file, f"{settings.synset}/{model}"
