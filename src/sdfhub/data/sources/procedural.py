"""Shapes from the embedded parametric generators: no download, closed meshes, any number of them."""

from collections.abc import Mapping

from sdfhub import procedural
from sdfhub.data.sources.source import Shape, Source, plain_categories
from sdfhub.errors import SdfhubError
from sdfhub.shapes import Mesh


class ProceduralSource(Source):
    """Chairs, lamps, planes, sofas and tables generated from (category, index).

    Args:
        categories: the categories to offer; only their names matter here.
        count: shapes offered per category; shape i is the same whatever the count.
    """

    name = "procedural"
    up = "z"

    def __init__(self, categories: Mapping, count: int = 1000):
        self.categories = sorted(plain_categories(categories))
        unknown = [name for name in self.categories if name not in procedural.CATEGORIES]
        if unknown:
            known = ", ".join(procedural.CATEGORIES)
            raise SdfhubError(f"category={unknown[0]}: data=procedural generates only {known}")
        if not 1 <= count <= 1_000_000:
            raise SdfhubError(f"data.source.count={count}: must lie between 1 and 1000000")
        self.count = count

    def shapes(self) -> list[Shape]:
        return [
            Shape(f"{category}/{index:04d}", category, f"{procedural.VERSION}/{category}/{index}")
            for category in self.categories
            for index in range(self.count)
        ]

    def load(self, shape: Shape) -> Mesh:
        return procedural.generate(shape.category, int(shape.id.rpartition("/")[2]))
