"""sdfhub: an experiment platform for neural signed distance functions."""

import os

# PyTorch's threads would keep a core busy for milliseconds after their work, and numba's wait for it
os.environ.setdefault("GOMP_SPINCOUNT", "1000")

from sdfhub.data.sampling import Preparation, prepare_mesh
from sdfhub.errors import RejectedMesh, SdfhubError
from sdfhub.shapes import NormalizedMesh, ShapeSamples

__all__ = ["NormalizedMesh", "Preparation", "RejectedMesh", "SdfhubError", "ShapeSamples", "prepare_mesh"]
