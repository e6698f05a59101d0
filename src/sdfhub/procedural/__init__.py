"""Parametric shapes of five categories, made on demand: index i of a category is always the same shape."""

from sdfhub.procedural.catalogue import CATEGORIES, VERSION, design, generate

__all__ = ["CATEGORIES", "VERSION", "design", "generate"]
