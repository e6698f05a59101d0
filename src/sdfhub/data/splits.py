"""Which shapes are trained on and which are held out."""

import hashlib
from collections import Counter
from collections.abc import Iterable
from itertools import chain, zip_longest
from typing import NamedTuple

from sdfhub.data.sources.source import Shape
from sdfhub.errors import SdfhubError


class Split(NamedTuple):
    """Training and held-out shapes; no shape is in both."""

    train: list[Shape]
    held_out: list[Shape]


def split(shapes: list[Shape], train: int | None, held_out: int, seed: int, at_most: bool = False) -> Split:
    """Training and held-out shapes, drawn evenly over the categories; `train` None takes all others.

    A seeded hash of its id orders the shapes of a category. Held-out shapes are taken from the front of
    that order and training shapes from its back, so that neither number changes the other side until
    the two meet, and a smaller `train` is a part of a larger one. Roles given by a split file hold: a
    side for which roles are given draws from those alone, the other from the shapes without a role.
    With `at_most` the numbers are upper bounds: where there are not enough shapes, or all are trained on, no
    more than a fifth of them is held out, but one of three.
    """
    if min(held_out, train or 0) < 0:
        raise SdfhubError(f"split: the numbers of shapes must not be negative, got {train} and {held_out}")
    ordered = sorted(shapes, key=lambda shape: hashlib.sha256(f"{seed}:{shape.id}".encode()).digest())
    free = [shape for shape in ordered if shape.split is None]
    unseen = [shape for shape in ordered if shape.split == "held_out"] or free
    pool = [shape for shape in ordered if shape.split == "train"] or free
    if at_most and unseen is pool and (train is None or train + held_out > len(pool)):
        held_out = min(held_out, max(len(pool) // 5, int(len(pool) >= 3)))
    chosen = _evenly(unseen)[:held_out]
    taken = {shape.id for shape in chosen}
    rest = [shape for shape in _evenly(reversed(pool)) if shape.id not in taken]
    is_short = len(chosen) < held_out or len(rest) < (train or 0)
    if (is_short and not at_most) or (not rest and train != 0):
        roles = Counter(shape.split for shape in shapes if shape.split)
        given = f" ({roles['train']} train and {roles['held_out']} held out by the split file)"
        asked = f"{'all others' if train is None else train} to train on and {held_out} to hold out"
        raise SdfhubError(f"too few shapes: {asked} wanted, there are {len(shapes)}{given if roles else ''}")
    return Split(train=rest[:train], held_out=chosen)


def _evenly(shapes: Iterable[Shape]) -> list[Shape]:
    """The shapes taken from each category in turn; the order within a category is kept."""
    by_category: dict[str, list[Shape]] = {}
    for shape in shapes:
        by_category.setdefault(shape.category, []).append(shape)
    rounds = zip_longest(*(by_category[name] for name in sorted(by_category)))
    return [shape for shape in chain.from_iterable(rounds) if shape is not None]
