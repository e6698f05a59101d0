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


@pytest.mark.parametrize("train, test", [(None, 0), (None, 10), (40, 10), (1, 1), (0, 50)])
def test_sides_never_overlap_and_have_their_size(train, test):
    parts = split(shapes(), train, test, seed=3)
    assert len(parts.test) == test and len(parts.train) == (50 - test if train is None else train)
    assert len(set(ids(parts.train + parts.test))) == len(parts.train) + len(parts.test)


def test_same_seed_same_split_whatever_the_order():
    assert split(shapes(), 20, 5, seed=1) == split(shapes()[::-1], 20, 5, seed=1)
    assert ids(split(shapes(), 20, 5, seed=1).test) != ids(split(shapes(), 20, 5, seed=2).test)


def test_a_limit_changes_no_role():
    small, large = split(shapes(), 10, 5, seed=0), split(shapes(), 40, 5, seed=0)
    assert small.test == large.test and small.train == large.train[:10]
    more_tests = split(shapes(), 10, 20, seed=0)
    assert more_tests.train == small.train and more_tests.test[:5] == small.test


def test_categories_are_drawn_evenly():
    parts = split(shapes(20, ("chairs", "lamps", "planes")), 12, 6, seed=0)
    for part, each in ((parts.train, 4), (parts.test, 2)):
        counts = [[s.category for s in part].count(c) for c in ("chairs", "lamps", "planes")]
        assert counts == [each] * 3


def test_a_small_category_is_made_up_for_by_the_others():
    mixed = shapes(30, ("chairs",)) + shapes(2, ("lamps",))
    train = split(mixed, 20, 0, seed=0).train
    assert [s.category for s in train].count("lamps") == 2 and len(train) == 20


def test_given_roles_hold():
    given = [dataclasses.replace(s, split="train" if i % 3 else "test") for i, s in enumerate(shapes())]
    parts = split(given, 10, 5, seed=0)
    assert {s.split for s in parts.train} == {"train"} and {s.split for s in parts.test} == {"test"}
    assert len(split(given, None, 0, seed=0).train) == 33  # test shapes are not trained on, even if unused


def test_a_side_without_roles_draws_from_the_rest():
    mixed = shapes(10, ("chairs",), role="test") + shapes(10, ("lamps",))
    parts = split(mixed, None, 4, seed=0)
    assert {s.category for s in parts.test} == {"chairs"} and len(parts.train) == 10


@pytest.mark.parametrize("train, test", [(51, 0), (46, 5), (None, 51), (None, 50)])
def test_too_few_shapes_say_how_many(train, test):
    with pytest.raises(SdfhubError, match=r"too few shapes: .*there are 50"):
        split(shapes(), train, test, seed=0)


def test_a_train_list_alone_offers_no_test_shapes():
    with pytest.raises(SdfhubError, match="50 train and 0 test by the split file"):
        split(shapes(role="train"), None, 1, seed=0)
