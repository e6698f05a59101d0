"""sdfhub: an experiment platform for neural signed distance functions."""

import importlib
import os
from importlib.metadata import version
from typing import Any

# PyTorch's threads would keep a core busy for milliseconds after their work, while others wait for it
os.environ.setdefault("GOMP_SPINCOUNT", "1000")

__version__ = version("sdfhub")

_MODULES = {  # of public names, imported when they are first asked for: not all need PyTorch
    "Activation": "sdfhub.model.activations",
    "AutoDecoder": "sdfhub.model.autodecoder",
    "Decoder": "sdfhub.model.decoder",
    "Encoding": "sdfhub.model.encodings",
    "Frame": "sdfhub.shapes",
    "NormalizedMesh": "sdfhub.shapes",
    "Preparation": "sdfhub.data.preparation.settings",
    "RejectedMesh": "sdfhub.errors",
    "SdfDataModule": "sdfhub.data.loading",
    "SdfhubError": "sdfhub.errors",
    "ShapeSamples": "sdfhub.shapes",
    "Source": "sdfhub.data.sources",
    "Space": "sdfhub.space",
    "load": "sdfhub.opening",
    "prepare_mesh": "sdfhub.data.preparation.sampling",
    "train": "sdfhub.training",
}
__all__ = sorted(_MODULES)


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
