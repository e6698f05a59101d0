"""ShapeNetCore, version 1 or 2, as it unpacks."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, StringConstraints

from sdfhub.data.sources.source import Shape, checked_categories, folder_safe
from sdfhub.data.sources.split_file import SourceOfFiles
from sdfhub.errors import SdfhubError

LAYOUTS = ("models/model_normalized.obj", "model.obj")  # of a model's mesh: version 2, version 1


class Category(BaseModel):
    """A category's settings: ShapeNet's number of it, a quoted string of digits."""

    synset: Annotated[str, StringConstraints(pattern=r"^\d+$")]


class ShapeNetSource(SourceOfFiles):
    """Models `<root>/<synset>/<model>/`, their meshes as in version 1 or 2.

    A model is known by its file's size and date, not its content: hashing ShapeNet at every start takes
    minutes.

    Args:
        categories: name -> {synset}.
        root: the folder that holds the synsets' folders.
        train_split, test_split: see `SourceOfFiles`.
    """

    def __init__(
        self,
        categories: Mapping[str, Any],
        root: str,
        train_split: str | None = None,
        test_split: str | None = None,
    ):
        super().__init__("shapenet", root, train_split, test_split)
        checked = checked_categories(categories, Category)
        self.synsets = {name: category.synset for name, category in sorted(checked.items())}

    def listed(self) -> Iterator[tuple[Shape, Path, str]]:
        for category, synset in self.synsets.items():
            folder = self.root / synset
            places = [model / layout for model in sorted(folder.glob("*")) for layout in LAYOUTS]
            files = {file.relative_to(folder).parts[0]: file for file in reversed(places) if file.is_file()}
            if not files:
                raise SdfhubError(f"{folder}: holds no <model>/{LAYOUTS[0]} or <model>/{LAYOUTS[1]}")
            for model, file in sorted(files.items()):
                credits = {"author": "ShapeNet", "licence": "ShapeNet terms of use", "title": model}
                id, state = f"{category}/{folder_safe(model)}", file.stat()
                shape = Shape(id, category, f"{state.st_size} {state.st_mtime_ns}", credits=credits)
                yield shape, file, f"{synset}/{model}"
