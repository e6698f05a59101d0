"""Which shapes are trained on and which are held out."""

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import chain, zip_longest

from sdfhub.data.sources.source import Shape
from sdfhub.errors import SdfhubError


@dataclass(frozen=True)
class Split:
    """Training and held-out shapes; no shape is in both."""

    train: list[Shape]
    test: list[Shape]


def split(shapes: list[Shape], train: int | None, test: int, seed: int) -> Split:
    """Train and test shapes, drawn evenly over the categories.

    A seeded hash of its id orders the shapes of a category. Test shapes are taken from the front of
    that order and training shapes from its back, so that neither number changes the other side until
    the two meet, and a smaller `train` is a part of a larger one. Roles given by a split file hold: a
    side for which roles are given draws from those alone, the other from the shapes without a role.

    Args:
        shapes: what the source offers; the order does not matter.
        train: number of training shapes; None takes all that are not test shapes.
        test: number of held-out shapes.
        seed: another seed, another order.

    Raises:
        SdfhubError: fewer shapes than asked for.
    """
    if test < 0 or (train is not None and train < 0):
        raise SdfhubError(f"split: the numbers of shapes must not be negative, got {train} and {test}")
    ordered = sorted(shapes, key=lambda shape: hashlib.sha256(f"{seed}:{shape.id}".encode()).digest())
    free = [shape for shape in ordered if shape.split is None]
    held_out = _evenly([shape for shape in ordered if shape.split == "test"] or free)[:test]
    taken = {shape.id for shape in held_out}
    pool = [shape for shape in ordered if shape.split == "train"] or free
    known = [shape for shape in _evenly(reversed(pool)) if shape.id not in taken]
    if len(held_out) < test or len(known) < (train or 0) or (train is None and not known):
        raise SdfhubError(_too_few(shapes, train, test))
    return Split(train=known[:train], test=held_out)


def _evenly(shapes: Iterable[Shape]) -> list[Shape]:
    """The shapes taken from each category in turn; the order within a category is kept."""
    by_category: dict[str, list[Shape]] = {}
    for shape in shapes:
        by_category.setdefault(shape.category, []).append(shape)
    rounds = zip_longest(*(by_category[name] for name in sorted(by_category)))
    return [shape for shape in chain.from_iterable(rounds) if shape is not None]


def _too_few(shapes: list[Shape], train: int | None, test: int) -> str:
    asked = "all others" if train is None else str(train)
    roles = [shape.split for shape in shapes]
    given = f" ({roles.count('train')} train and {roles.count('test')} test by the split file)"
    there = f"{len(shapes)}{given if any(roles) else ''}"
    return f"too few shapes: {asked} to train on and {test} to hold out are asked for, there are {there}"
