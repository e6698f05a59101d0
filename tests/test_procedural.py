"""Properties of the procedural shapes: closed solids, repeatable, distinct, moved by every parameter."""

from functools import cache

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from sdfhub.errors import SdfhubError
from sdfhub.procedural import CATEGORIES, design, generate

SAMPLE = [*range(0, 96, 8), 69]  # 69: a Chesterfield on tapered legs


@pytest.fixture(scope="module")
def meshes() -> dict[str, list[tuple[np.ndarray, np.ndarray]]]:
    return {category: [generate(category, i) for i in SAMPLE] for category in CATEGORIES}


def shells(vertices: np.ndarray, faces: np.ndarray) -> int:
    ends = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    graph = coo_array((np.ones(faces.size), ends), shape=(len(vertices),) * 2)
    return connected_components(graph, directed=False)[0]


def volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    return float(np.linalg.det(vertices[faces] - vertices.mean(0)).sum() / 6)


@pytest.mark.parametrize("category", CATEGORIES)
def test_every_edge_is_shared_by_two_faces_that_run_along_it_in_opposite_directions(meshes, category):
    for vertices, faces in meshes[category]:
        assert vertices.dtype == np.float64 and faces.dtype == np.int64
        directed = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)
        key = directed @ [len(vertices), 1]
        assert len(np.unique(key)) == len(key)
        assert np.array_equal(np.sort(key), np.sort(directed[:, ::-1] @ [len(vertices), 1]))


@pytest.mark.parametrize("category", CATEGORIES)
def test_each_shape_is_one_solid_of_positive_volume_and_moderate_size(meshes, category):
    for index, (vertices, faces) in zip(SAMPLE, meshes[category], strict=True):
        assert shells(vertices, faces) == 1, f"{category} {index}"
        assert volume(vertices, faces) > 0
        assert 200 <= len(faces) <= 20_000
        assert np.isfinite(vertices).all()


@pytest.mark.parametrize("category", CATEGORIES)
def test_an_index_always_gives_the_same_shape(meshes, category):
    for position in (0, len(SAMPLE) - 1):
        vertices, faces = generate(category, SAMPLE[position])
        assert np.array_equal(vertices, meshes[category][position][0])
        assert np.array_equal(faces, meshes[category][position][1])


@pytest.mark.parametrize("category", CATEGORIES)
def test_a_thousand_designs_are_distinct_and_within_their_ranges(category):
    designs = [design(category, i) for i in range(1000)]
    assert len({tuple(vars(d).values()) for d in designs}) == 1000
    for name, domain in designs[0].parameters.items():
        values = [getattr(d, name) for d in designs]
        if isinstance(domain, tuple):
            assert domain[0] <= min(values) and max(values) <= domain[1]
        else:
            assert set(values) == set(domain)


@pytest.mark.parametrize("category", CATEGORIES)
def test_every_parameter_moves_the_shape(category):
    for name in design(category, 0).parameters:
        assert any(_moves(category, i, name) for i in range(120)), f"{category}.{name} changes nothing"


@cache
def _measures(category: str, index: int, **changed) -> tuple[float, int]:
    chosen = design(category, index)
    vars(chosen).update(changed)
    solid = chosen.build()
    return solid.volume(), solid.num_tri()


def _moves(category: str, index: int, name: str) -> bool:
    """Whether another value of one parameter gives this design another solid."""
    chosen = design(category, index)
    value, domain = getattr(chosen, name), chosen.parameters[name]
    if isinstance(domain, tuple):
        other = max(domain, key=lambda end: abs(end - value))
    else:
        other = next(option for option in domain if option != value)
    before, after = _measures(category, index), _measures(category, index, **{name: other})
    return abs(before[0] - after[0]) > 1e-9 or before[1] != after[1]


@pytest.mark.parametrize(
    "category, index, words",
    [("boats", 0, "boats: .*choose chairs, lamps, planes, sofas, tables"), ("chairs", -1, "index=-1")],
)
def test_an_unknown_shape_is_refused_with_the_choices(category, index, words):
    with pytest.raises(SdfhubError, match=words):
        generate(category, index)
