"""Shapes from the embedded parametric generators: no download, closed meshes, any number of them."""

from collections.abc import Iterable
from itertools import product
from typing import Annotated

from pydantic import Field

from sdfhub import procedural
from sdfhub.data.sources.source import Shape, Source
from sdfhub.errors import SdfhubError
from sdfhub.shapes import Mesh


class ProceduralSource(Source):
    """Chairs, lamps, planes, sofas and tables generated from (category, index).

    Args:
        categories: names of the categories to offer, or a mapping of them.
        count: shapes offered per category; shape i is the same whatever the count.
    """

    name = "procedural"
    up = "z"

    def __init__(self, categories: Iterable[str], count: Annotated[int, Field(ge=1, le=1_000_000)] = 1000):
        self.categories, self.count = sorted(categories), count
        if unknown := [name for name in self.categories if name not in procedural.CATEGORIES]:
            known = ", ".join(procedural.CATEGORIES)
            raise SdfhubError(f"category={unknown[0]}: data=procedural generates only {known}")

    def shapes(self) -> list[Shape]:
        pairs = product(self.categories, range(self.count))
        return [Shape(f"{name}/{i:04d}", name, f"{procedural.VERSION}/{name}/{i}") for name, i in pairs]

    def load(self, shape: Shape) -> Mesh:
        return procedural.generate(shape.category, int(shape.id.rpartition("/")[2]))
