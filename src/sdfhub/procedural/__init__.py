"""Parametric shapes of five categories, made on demand: index i of a category is always the same shape.

A category is a class that lists its `parameters` in the order in which they are drawn: (low, high) is a
number drawn uniformly from that range, [a, a, b] one of the options, likelier where it is repeated.
"""

from typing import Any

import numpy as np
from manifold3d import Manifold

from sdfhub.errors import SdfhubError
from sdfhub.procedural import chairs, lamps, planes, sofas, tables
from sdfhub.shapes import Mesh

VERSION = 3  # raised whenever a generator changes what it makes; stores hash it

# A category's place in this order seeds its draws: never change it, add at the end.
_DESIGNS: dict[str, Any] = {"chairs": chairs.Chair, "lamps": lamps.Lamp, "planes": planes.Plane}
_DESIGNS |= {"sofas": sofas.Sofa, "tables": tables.Table}
CATEGORIES = tuple(_DESIGNS)


def design(category: str, index: int):
    """Shape `index` >= 0 of a category by its parameters, always the same; `.build()` makes the solid."""
    if category not in _DESIGNS:
        raise SdfhubError(f"category={category}: no such procedural category; choose {', '.join(CATEGORIES)}")
    if index < 0:
        raise SdfhubError(f"index={index}: procedural shapes are counted from 0")
    rng, values = np.random.default_rng([CATEGORIES.index(category) + 1, index]), {}
    for name, domain in _DESIGNS[category].parameters.items():
        values[name] = rng.uniform(*domain) if type(domain) is tuple else domain[rng.integers(len(domain))]
    return _DESIGNS[category](**values)


def generate(category: str, index: int) -> Mesh:
    """The mesh of shape `index` >= 0 of a category: closed, oriented outwards, one shell, always the same.

    It is in metres, +z up, its front towards -y.
    """
    solid = design(category, index).build()
    pieces = solid.decompose()
    if len(pieces) > 1:  # pockets closed in between the parts, slivers that a boolean split off
        least = 1e-5 * solid.volume()
        solid = Manifold.compose([piece for piece in pieces if piece.volume() > least])
    mesh = solid.to_mesh64()
    return Mesh(mesh.vert_properties[:, :3].astype(np.float64), mesh.tri_verts.astype(np.int64))
