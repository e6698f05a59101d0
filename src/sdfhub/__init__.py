"""sdfhub: an experiment platform for neural signed distance functions."""

import os
from typing import Any

# PyTorch's threads would keep a core busy for milliseconds after their work, while others wait for it
os.environ.setdefault("GOMP_SPINCOUNT", "1000")

from sdfhub.data.preparation.sampling import Preparation, prepare_mesh
from sdfhub.errors import RejectedMesh, SdfhubError
from sdfhub.shapes import Frame, NormalizedMesh, ShapeSamples

__all__ = ["Frame", "NormalizedMesh", "Preparation", "RejectedMesh", "SdfhubError", "ShapeSamples"]
__all__ += ["Space", "load", "prepare_mesh"]

_LATER = {"Space": "sdfhub.space", "load": "sdfhub.tasks.opening"}
"""What is imported when it is first asked for: the processes that prepare shapes need no model."""


def __getattr__(name: str) -> Any:
    if name not in _LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import importlib

    return getattr(importlib.import_module(_LATER[name]), name)
