"""Splits are by shape, seeded, stable under their limits, and never overlap."""

import dataclasses

import pytest

from sdfhub.data.sources.source import Shape
from sdfhub.data.splits import split
from sdfhub.errors import SdfhubError


def shapes(count: int = 50, categories: tuple[str, ...] = ("chairs",), role=None) -> list[Shape]:
    return [Shape(f"{c}/{i:04d}", c, "f", split=role) for c in categories for i in range(count)]


def ids(part: list[Shape]) -> list[str]:
    return [shape.id for shape in part]


@pytest.mark.parametrize("train, held_out", [(None, 0), (None, 10), (40, 10), (1, 1), (0, 50)])
def test_sides_never_overlap_and_have_their_size(train, held_out):
    parts = split(shapes(), train, held_out, seed=3)
    assert len(parts.held_out) == held_out
    assert len(parts.train) == (50 - held_out if train is None else train)
    assert len(set(ids(parts.train + parts.held_out))) == len(parts.train) + len(parts.held_out)


def test_same_seed_same_split_whatever_the_order():
    assert split(shapes(), 20, 5, seed=1) == split(shapes()[::-1], 20, 5, seed=1)
    assert ids(split(shapes(), 20, 5, seed=1).held_out) != ids(split(shapes(), 20, 5, seed=2).held_out)


def test_a_limit_changes_no_role():
    small, large = split(shapes(), 10, 5, seed=0), split(shapes(), 40, 5, seed=0)
    assert small.held_out == large.held_out and small.train == large.train[:10]
    more = split(shapes(), 10, 20, seed=0)
    assert more.train == small.train and more.held_out[:5] == small.held_out


def test_categories_are_drawn_evenly():
    parts = split(shapes(20, ("chairs", "lamps", "planes")), 12, 6, seed=0)
    for part, each in ((parts.train, 4), (parts.held_out, 2)):
        counts = [[s.category for s in part].count(c) for c in ("chairs", "lamps", "planes")]
        assert counts == [each] * 3


def test_a_small_category_is_made_up_for_by_the_others():
    mixed = shapes(30, ("chairs",)) + shapes(2, ("lamps",))
    train = split(mixed, 20, 0, seed=0).train
    assert [s.category for s in train].count("lamps") == 2 and len(train) == 20


def test_given_roles_hold():
    given = [dataclasses.replace(s, split="train" if i % 3 else "held_out") for i, s in enumerate(shapes())]
    parts = split(given, 10, 5, seed=0)
    assert {s.split for s in parts.train} == {"train"} and {s.split for s in parts.held_out} == {"held_out"}
    assert len(split(given, None, 0, seed=0).train) == 33  # test shapes are not trained on, even if unused


def test_a_side_without_roles_draws_from_the_rest():
    mixed = shapes(10, ("chairs",), role="held_out") + shapes(10, ("lamps",))
    parts = split(mixed, None, 4, seed=0)
    assert {s.category for s in parts.held_out} == {"chairs"} and len(parts.train) == 10


@pytest.mark.parametrize("train, held_out", [(51, 0), (46, 5), (None, 51), (None, 50)])
def test_too_few_shapes_say_how_many(train, held_out):
    with pytest.raises(SdfhubError, match=r"too few shapes: .*there are 50"):
        split(shapes(), train, held_out, seed=0)


def test_a_train_list_alone_offers_no_test_shapes():
    with pytest.raises(SdfhubError, match="50 train and 0 held out by the split file"):
        split(shapes(role="train"), None, 1, seed=0)


@pytest.mark.parametrize(
    "there, asked, kept",
    [
        (8, (20, 4), (7, 1)),
        (8, (None, 4), (7, 1)),
        (24, (20, 4), (20, 4)),
        (22, (20, 4), (18, 4)),
        (100, (20, 4), (20, 4)),
        (8, (4, 4), (4, 4)),
        (3, (20, 4), (2, 1)),
        (2, (20, 4), (2, 0)),
        (1, (20, 4), (1, 0)),
        (8, (20, 0), (8, 0)),
    ],
)
def test_of_a_collection_numbers_are_upper_bounds_and_most_is_trained_on(there, asked, kept):
    parts = split(shapes(there), *asked, seed=0, at_most=True)
    assert (len(parts.train), len(parts.held_out)) == kept


def test_a_collection_with_given_roles_keeps_them():
    given = shapes(5, role="train") + shapes(4, ("lamps",), role="held_out")
    parts = split(given, 20, 3, seed=0, at_most=True)
    assert (len(parts.train), len(parts.held_out)) == (5, 3)
    with pytest.raises(SdfhubError, match="too few shapes"):
        split(shapes(5, role="held_out"), 20, 4, seed=0, at_most=True)
