"""The data sources, side by side: each lists shapes and loads one of them."""

from sdfhub.data.sources.deepsdf import DeepSdfSource as DeepSdfSource
from sdfhub.data.sources.folder import FolderSource as FolderSource
from sdfhub.data.sources.folder import ShapeNetSource as ShapeNetSource
from sdfhub.data.sources.open import OpenSource as OpenSource
from sdfhub.data.sources.procedural import ProceduralSource as ProceduralSource
