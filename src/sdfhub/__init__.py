"""sdfhub: an experiment platform for neural signed distance functions."""

from sdfhub.data.sampling import Preparation, prepare_mesh
from sdfhub.errors import RejectedMesh, SdfhubError
from sdfhub.shapes import NormalizedMesh, ShapeSamples

__all__ = ["NormalizedMesh", "Preparation", "RejectedMesh", "SdfhubError", "ShapeSamples", "prepare_mesh"]
