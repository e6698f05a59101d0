"""Directions spread evenly over the sphere."""

import numpy as np


def sphere_directions(count: int) -> np.ndarray:
    """[count, 3] unit vectors spread evenly (a Fibonacci lattice); neighbours lie far apart in the order."""
    height = 1 - (2 * np.arange(count) + 1) / count
    turn = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    radius = np.sqrt(1 - height**2)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), height], axis=1)
