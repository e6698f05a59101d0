"""ShapeNetCore, version 1 or 2, as it unpacks."""

from collections.abc import Iterator, Mapping
from pathlib import Path

from sdfhub.data.sources.mesh_files import read_mesh
from sdfhub.data.sources.source import (
    Shape,
    Source,
    absolute,
    folder_safe,
    name_of_root,
    plain_categories,
    state_of,
)
from sdfhub.data.sources.split_file import with_roles
from sdfhub.errors import SdfhubError
from sdfhub.shapes import Mesh

LAYOUTS = ("models/model_normalized.obj", "model.obj")
"""Where a model's mesh lies in its folder: version 2, version 1."""

LICENCE = "ShapeNet terms of use"


class ShapeNetSource(Source):
    """Models `<root>/<synset>/<model>/`, their meshes as in version 1 or 2.

    A model is known by its file's size and date, not its content: hashing ShapeNet at every start takes
    minutes.

    Args:
        categories: name -> {synset}.
        root: the folder that holds the synsets' folders.
        train_split: file listing the training models, DeepSDF's form; see `split_file.with_roles`.
        test_split: the same for held-out models. Where either is given, unlisted models are left out.
    """

    def __init__(
        self,
        categories: Mapping,
        root: str,
        train_split: str | None = None,
        test_split: str | None = None,
    ):
        self.synsets = {name: _synset(name, each) for name, each in plain_categories(categories).items()}
        self.root = Path(absolute(root))
        self.train_split, self.test_split = absolute(train_split), absolute(test_split)
        self.name = name_of_root("shapenet", self.root)

    def shapes(self) -> list[Shape]:
        if not self.root.is_dir():
            raise SdfhubError(f"data.source.root={self.root}: no such folder; unpack ShapeNetCore there")
        found = [pair for name in sorted(self.synsets) for pair in self._models(name)]
        return with_roles(found, self.train_split, self.test_split)

    def load(self, shape: Shape) -> Mesh:
        folder = self.root / self.synsets[shape.category] / shape.credits["title"]
        return read_mesh(_mesh_file(folder) or folder)

    def _models(self, category: str) -> Iterator[tuple[Shape, str]]:
        synset = self.synsets[category]
        files = {folder.name: _mesh_file(folder) for folder in sorted((self.root / synset).glob("*"))}
        files = {model: file for model, file in files.items() if file}
        if not files:
            raise SdfhubError(f"{self.root / synset}: holds no <model>/{LAYOUTS[0]} or <model>/{LAYOUTS[1]}")
        for model, file in files.items():
            credits = {"author": "ShapeNet", "licence": LICENCE, "title": model}
            shape = Shape(f"{category}/{folder_safe(model)}", category, state_of(file), credits=credits)
            yield shape, f"{synset}/{model}"


def _mesh_file(folder: Path) -> Path | None:
    return next((folder / layout for layout in LAYOUTS if (folder / layout).is_file()), None)


def _synset(name: str, settings: dict) -> str:
    synset = settings.get("synset")
    if not (isinstance(synset, str) and synset.isdigit()):
        raise SdfhubError(f"category.{name}.synset={synset}: must be a quoted string of digits")
    return synset
