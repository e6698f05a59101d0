"""Worlds with +y up and worlds with +z up: a turn about x leads from one to the other."""

from typing import Literal

import numpy as np

UpAxis = Literal["y", "z"]


def turned_up(points: np.ndarray, up: UpAxis, wanted: UpAxis) -> np.ndarray:
    """Points [N, 3] of a world with `up` up in one with `wanted` up; the front looks to +z or -y then."""
    if up == wanted:
        return points
    x, y, z = np.asarray(points).T
    return np.column_stack([x, -z, y] if wanted == "z" else [x, z, -y])
