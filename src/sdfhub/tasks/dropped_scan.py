"""A scan that was dropped on a page: its bytes become the code of a shape."""

from pathlib import PurePath

import numpy as np
from torch import Tensor

from sdfhub.data.mesh import FORMATS, triangles_of
from sdfhub.data.preparation import Preparation
from sdfhub.data.sampling import prepare_mesh
from sdfhub.errors import SdfhubError
from sdfhub.space import Space

__all__ = ["FORMATS", "fit_scan"]

PREPARATION = Preparation(samples=100_000, surface_points=4000)
"""Enough for a fit, in a second or two."""


def fit_scan(space: Space, name: str, content: bytes) -> tuple[Tensor, np.ndarray]:
    """The code [L] of the shape in a mesh file, and points [M, 3] of its surface, normalised frame.

    Raises:
        SdfhubError: names the file and what is wrong with it.
    """
    suffix = PurePath(name).suffix.lower()
    if suffix not in FORMATS:
        raise SdfhubError(f"{name}: not a mesh format known here ({' '.join(FORMATS)})")
    try:
        prepared = prepare_mesh(triangles_of(content, suffix, name), PREPARATION)
    except SdfhubError as error:
        raise SdfhubError(str(error) if name in str(error) else f"{name}: {error}") from error
    inside = prepared.sdf < 0
    each = min(inside.sum(), (~inside).sum(), space.how_to_fit.samples // 2)
    rows = np.concatenate([np.flatnonzero(side)[:each] for side in (inside, ~inside)])
    return space.fit(points=prepared.points[rows], sdf=prepared.sdf[rows]), prepared.surface_points
