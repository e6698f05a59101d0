import numpy as np
import pytest
import trimesh
from manifold3d import CrossSection, Manifold, OpType

from sdfhub.data.preparation.sampling import prepare_mesh
from sdfhub.data.preparation.settings import Preparation
from sdfhub.data.preparation.signs import SIGN_METHODS, Signs
from sdfhub.errors import RejectedMesh
from sdfhub.procedural import CATEGORIES, generate
from sdfhub.shapes import RADIUS
from tests.broken_twins import BREAKAGES, chair_parts, errors, refined, ring, signed_distance, triangles

FEW = Preparation(samples=20_000, surface_points=2000)
CHAIR = triangles(refined(Manifold.batch_boolean(chair_parts(), OpType.Add)))
SHAPES = {"own chair": CHAIR, "ring": triangles(ring())}
SHAPES |= {name: generate(name, 0) for name in ("chairs", "lamps", "planes") if name in CATEGORIES}


def sheet(count: int = 12):
    """An open sheet with waves: no inside anywhere."""
    x, y = np.meshgrid(np.linspace(-1, 1, count), np.linspace(-1, 1, count), indexing="ij")
    grid = np.arange(count * count).reshape(count, count)
    a, b, c, d = (g.ravel() for g in (grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return np.stack([x, y, 0.2 * np.sin(3 * x)], -1).reshape(-1, 3), faces


@pytest.mark.parametrize("breakage", BREAKAGES)
@pytest.mark.parametrize("shape", SHAPES)
def test_broken_twin_keeps_the_signs_and_distances_of_its_clean_twin(shape, breakage):
    broken = BREAKAGES[breakage](SHAPES[shape], np.random.default_rng(1))
    right, error = errors(prepare_mesh(broken, FEW), SHAPES[shape])
    assert right >= 0.995
    assert error < 0.002


def test_overlapping_parts_count_as_their_union():
    parts = [triangles(part) for part in chair_parts()]
    first = np.cumsum([0] + [len(vertices) for vertices, _ in parts])
    soup = np.concatenate([v for v, _ in parts]), np.concatenate([f + n for (_, f), n in zip(parts, first)])  # noqa: B905
    right, error = errors(prepare_mesh(soup, FEW), CHAIR)
    assert right >= 0.995
    assert error < 0.002


def test_votes_are_mostly_right_and_the_unanimous_ones_more_so():
    kept = prepare_mesh(CHAIR, Preparation(sign="vote", samples=20_000))
    dropped = prepare_mesh(CHAIR, Preparation(sign="vote", samples=20_000, drop_uncertain=True))
    assert len(dropped.points) < len(kept.points)
    assert errors(dropped, CHAIR)[0] > errors(kept, CHAIR)[0] >= 0.97


def test_fast_path_is_taken_on_clean_meshes_only():
    assert prepare_mesh(CHAIR, FEW).statistics["fast_path"] == 1
    vertices, faces = CHAIR
    inside_out = vertices, faces[:, ::-1]
    assert prepare_mesh(inside_out, FEW).statistics["fast_path"] == 0
    assert prepare_mesh((vertices, faces[1:]), FEW).statistics["fast_path"] == 0
    sphere = triangles(Manifold.sphere(0.5, 32))
    two = (
        np.concatenate([sphere[0], sphere[0] + [0.6, 0, 0]]),
        np.concatenate([sphere[1], sphere[1] + len(sphere[0])]),
    )
    assert prepare_mesh(two, FEW).statistics["fast_path"] == 0


def test_what_pseudo_normals_get_wrong_is_left_to_the_winding_number(monkeypatch):
    everywhere = lambda points, *_: Signs(np.ones(len(points), bool), np.ones(len(points), bool))  # noqa: E731
    monkeypatch.setitem(SIGN_METHODS, "pseudo_normal", everywhere)
    shape = prepare_mesh(
        triangles(Manifold.cube((1, 1, 1), center=True)), Preparation(samples=5000, min_faces=12)
    )
    assert shape.statistics["fast_path"] == 0
    assert np.array_equal(shape.sdf < 0, np.abs(shape.points).max(axis=1) < RADIUS / 3**0.5)


def test_samples_lie_where_the_settings_put_them():
    samples = prepare_mesh(CHAIR, Preparation(samples=100_000))
    near = np.abs(samples.sdf)
    assert samples.points.shape == (100_000, 3) and samples.surface_points.shape == (30_000, 3)
    # of a plane's jitter, half lies within 0.674 standard deviations; a chair is close enough to planes
    expected = 0.47 * (1 - 2 * 0.158655) + 0.47 * 0.974
    assert np.mean(near < 0.005**0.5) == pytest.approx(expected + 0.01, abs=0.06)
    far = np.abs(samples.points).max(axis=1)
    assert 0.98 < far.max() < 1.5
    assert np.linalg.norm(samples.mesh.vertices, axis=1).max() == pytest.approx(RADIUS, abs=1e-6)


def test_decoys_are_mirrored_points_with_distances_of_their_own():
    plain, decoys = (
        prepare_mesh(CHAIR, Preparation(samples=20_000, near_share=0.5, decoy_share=share))
        for share in (0, 0.3)
    )
    places = [samples.points[np.lexsort(np.abs(samples.points).T)] for samples in (plain, decoys)]
    assert np.array_equal(np.abs(places[0]), np.abs(places[1]))
    mirrored = (places[0] != places[1]).sum(axis=1)
    assert mirrored.max() == 1 and mirrored.sum() == 0.3 * 10_000
    assert errors(decoys, CHAIR) == pytest.approx((1, 0), abs=0.002)


def test_rows_come_in_random_order():
    samples = prepare_mesh(CHAIR, FEW)
    steps = np.linalg.norm(np.diff(samples.points, axis=0), axis=1)
    assert np.median(steps) > 0.3
    assert np.mean(samples.sdf[:5000]) == pytest.approx(np.mean(samples.sdf), abs=0.01)


def test_distances_are_exact_for_the_points_as_stored():
    samples = prepare_mesh(CHAIR, FEW)
    truth = signed_distance((samples.mesh.vertices, samples.mesh.faces), samples.points.astype(np.float64))
    np.testing.assert_allclose(samples.sdf, truth, atol=1e-7)


def test_surface_points_lie_on_the_surface_with_outward_normals():
    samples = prepare_mesh(BREAKAGES["all of it"](CHAIR, np.random.default_rng(0)), FEW)
    source = samples.surface_points / samples.frame.scale + samples.frame.center
    step = 2e-3 / samples.frame.scale * samples.surface_normals
    outside, inside = signed_distance(CHAIR, source + step), signed_distance(CHAIR, source - step)
    assert np.abs(signed_distance(CHAIR, source)).max() < 1e-6
    assert np.mean((outside > 0) & (inside < 0)) > 0.995


def test_seed_decides_the_samples():
    broken = BREAKAGES["all of it"](CHAIR, np.random.default_rng(0))
    one, same, other = (prepare_mesh(broken, FEW, seed=s) for s in (3, 3, 4))
    np.testing.assert_array_equal(one.points, same.points)
    np.testing.assert_array_equal(one.sdf, same.sdf)
    np.testing.assert_array_equal(one.surface_normals, same.surface_normals)
    assert one.statistics == same.statistics
    assert not np.array_equal(one.points, other.points)


@pytest.mark.parametrize("size", [1e20, 1e-12, 1e150])
def test_scale_and_place_of_the_source_do_not_matter(size):
    vertices, faces = CHAIR
    moved = prepare_mesh((vertices * size + 3 * size, faces), FEW)
    plain = prepare_mesh(CHAIR, FEW)
    np.testing.assert_allclose(moved.sdf, plain.sdf, atol=1e-6)
    np.testing.assert_allclose(moved.frame.center / size - 3, plain.frame.center, atol=1e-9)
    assert moved.frame.scale * size == pytest.approx(plain.frame.scale)


def test_a_trimesh_and_unmerged_triangles_give_the_same_samples():
    vertices, faces = CHAIR
    loose = trimesh.Trimesh(
        vertices[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3), process=False
    )
    samples = prepare_mesh(loose, FEW)
    assert samples.statistics["fast_path"] == 1
    assert errors(samples, CHAIR)[0] == 1


def test_sheets_count_for_distance_but_have_no_inside():
    vertices, faces = sheet()
    box = triangles(refined(Manifold.cube([1.2, 1.2, 0.8], True).translate([0, 0, -1.5])))
    both = (
        np.concatenate([box[0], 0.5 * vertices + [0, 0, 0.1]]),
        np.concatenate([box[1], faces + len(box[0])]),
    )
    samples = prepare_mesh(both, FEW)
    assert 0.02 < samples.statistics["two_sided_area"] < 0.25
    source = samples.points / samples.frame.scale + samples.frame.center
    around = np.abs(source[:, 2] - 0.1) < 0.3
    assert (samples.sdf[around] >= 0).all()
    assert samples.sdf[around].min() / samples.frame.scale < 0.005
    on_box = samples.surface_points[:, 2] / samples.frame.scale + samples.frame.center[2]
    assert on_box.max() < -1.09


BAD_MESHES = {
    "no_faces": (np.zeros((0, 3)), np.zeros((0, 3), int)),
    "malformed_arrays": (CHAIR[0], np.zeros((60, 4), int)),
    "face_index_out_of_range": (CHAIR[0], CHAIR[1] + 1),
    "non_finite_vertices": (np.where(np.arange(len(CHAIR[0]))[:, None] == 5, np.nan, CHAIR[0]), CHAIR[1]),
    "too_few_faces": triangles(Manifold.cube()),
    "flat": (CHAIR[0] * [1, 1, 0.001], CHAIR[1]),
    "zero_area_faces": (CHAIR[0], np.concatenate([CHAIR[1], CHAIR[1][:, [0, 0, 1]]])),
    "two_sided_area": sheet(),
    "inside_fraction": triangles(
        refined(CrossSection.square([2, 2], True).extrude(0.0001) + Manifold.cube([0.001, 0.001, 0.1]), 0.3)
    ),
}


@pytest.mark.parametrize("reason", BAD_MESHES)
def test_bad_mesh_is_rejected_with_its_reason(reason):
    with pytest.raises(RejectedMesh) as caught:
        prepare_mesh(BAD_MESHES[reason], FEW)
    assert caught.value.reason == reason
    assert caught.value.detail


def test_too_many_pieces_are_rejected():
    corners = np.random.default_rng(0).uniform(-1, 1, (2500, 1, 3)) + 0.02 * np.eye(3)
    with pytest.raises(RejectedMesh, match="too_many_components"):
        prepare_mesh((corners.reshape(-1, 3), np.arange(7500).reshape(-1, 3)), FEW)


def test_a_half_open_shape_is_ambiguous():
    vertices, faces = triangles(refined(Manifold.sphere(1, 64), 0.1))
    random_half = np.random.default_rng(0).random(len(faces)) < 0.35
    loose = Preparation(samples=20_000, two_sided_above=0.5)  # nothing is a sheet
    with pytest.raises(RejectedMesh, match="ambiguous_signs"):
        prepare_mesh((vertices, faces[random_half]), loose)


def test_vote_refuses_what_deepsdf_would():
    punctured = CHAIR[0], CHAIR[1][np.random.default_rng(0).random(len(CHAIR[1])) > 0.1]
    with pytest.raises(RejectedMesh, match="contradictory"):
        prepare_mesh(punctured, Preparation(sign="vote", samples=1000))


def test_wrong_settings_name_their_key():
    with pytest.raises(ValueError, match="near_share"):
        Preparation(near_share=1.5)
