"""The data sources, side by side: each lists shapes and loads one of them."""

from sdfhub.data.sources.procedural import ProceduralSource
from sdfhub.data.sources.source import Shape, Source

__all__ = ["ProceduralSource", "Shape", "Source"]
