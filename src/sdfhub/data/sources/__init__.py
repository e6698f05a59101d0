"""The data sources, side by side: each lists shapes and loads one of them."""

from sdfhub.data.sources.deepsdf import DeepSdfSource
from sdfhub.data.sources.folder import FolderSource
from sdfhub.data.sources.open import OpenSource
from sdfhub.data.sources.procedural import ProceduralSource
from sdfhub.data.sources.shapenet import ShapeNetSource
from sdfhub.data.sources.source import Shape, Source

__all__ = [
    "DeepSdfSource",
    "FolderSource",
    "OpenSource",
    "ProceduralSource",
    "Shape",
    "ShapeNetSource",
    "Source",
]
