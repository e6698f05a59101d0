"""Parametric shapes of five categories, made on demand: index i of a category is always the same shape."""

import numpy as np
from manifold3d import Manifold

from sdfhub.errors import SdfhubError
from sdfhub.procedural import chairs, lamps, planes, sofas, tables
from sdfhub.procedural.parameters import draw
from sdfhub.shapes import Mesh

VERSION = 3  # raised whenever a generator changes what it makes; stores hash it

# A category's place in this order seeds its draws: never change it, add at the end.
_DESIGNS = {"chairs": chairs.Chair, "lamps": lamps.Lamp, "planes": planes.Plane}
_DESIGNS |= {"sofas": sofas.Sofa, "tables": tables.Table}
CATEGORIES = tuple(_DESIGNS)


def design(category: str, index: int):
    """The parameters of shape `index` >= 0 of a category, always the same; `.build()` makes the solid."""
    if category not in _DESIGNS:
        raise SdfhubError(f"category={category}: no such procedural category; choose {', '.join(CATEGORIES)}")
    if index < 0:
        raise SdfhubError(f"index={index}: procedural shapes are counted from 0")
    return draw(_DESIGNS[category], np.random.default_rng([CATEGORIES.index(category) + 1, index]))


def generate(category: str, index: int) -> Mesh:
    """The mesh of shape `index` >= 0 of a category: closed, oriented outwards, one shell, always the same.

    It is in metres, +z up, its front towards -y.
    """
    mesh = _outer_shell(design(category, index).build()).to_mesh64()
    vertices = np.array(mesh.vert_properties[:, :3], dtype=np.float64)
    return Mesh(vertices, np.array(mesh.tri_verts, dtype=np.int64))


def _outer_shell(solid: Manifold) -> Manifold:
    """The solid without pockets closed in between its parts and without slivers that a boolean split off."""
    pieces = solid.decompose()
    if len(pieces) == 1:
        return solid
    least = 1e-5 * solid.volume()
    return Manifold.compose([piece for piece in pieces if piece.volume() > least])
