"""Metrics agree with independent computations, and failures are counted."""

import dataclasses

import numpy as np
import pytest
import torch
import trimesh
from dense_meshing import mesh_dense

from sdfhub.geometry.metrics import chamfer, is_closed, judge, point_to_surface, summarize, volumetric_iou
from sdfhub.geometry.surface import sample_surface
from sdfhub.shapes import Frame, NormalizedMesh

EMPTY = np.empty((0, 3)), np.empty((0, 3), np.int64)


def arrays(mesh):
    return np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int64)


def icosphere(radius=0.6, subdivisions=4):
    return arrays(trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius))


def cube(extent=1.0, centre=(0, 0, 0)):
    mesh = trimesh.creation.box(extents=[extent] * 3)
    return arrays(mesh.apply_translation(centre))


def truth(mesh, scale=1.0):
    return NormalizedMesh(*mesh, Frame(np.zeros(3), scale))


def brute_force_chamfer(a, b):
    squared = ((a[:, None] - b[None]) ** 2).sum(-1)
    return squared.min(1).mean() + squared.min(0).mean()


@pytest.mark.parametrize("seed", range(3))
def test_chamfer_equals_brute_force(seed):
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(700, 3)), rng.uniform(-1, 2, (300, 3))
    assert chamfer(a, b) == pytest.approx(brute_force_chamfer(a, b), abs=1e-9)
    assert chamfer(a, b) == pytest.approx(chamfer(b, a), abs=1e-12)


def test_chamfer_is_a_mean_of_squares():
    a = np.zeros((5, 3))
    b = np.array([[0.0, 0, 2.0], [0, 0, 3.0]])
    assert chamfer(a, b) == pytest.approx(4 + (4 + 9) / 2)
    assert chamfer(a, a[:1]) == 0


def test_samples_are_uniform_by_area_and_repeat_with_the_seed():
    vertices = np.array([[0, 0, 0], [3, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1]], float)
    faces = np.array([[0, 1, 2], [3, 4, 5]])
    points, normals = sample_surface(vertices, faces, 40_000, 3)
    assert np.mean(points[:, 2] == 0) == pytest.approx(0.75, abs=0.01)
    assert points[points[:, 2] == 0].mean(axis=0) == pytest.approx([1, 1 / 3, 0], abs=0.02)
    assert np.allclose(normals, [0, 0, 1])
    assert np.array_equal(points, sample_surface(vertices, faces, 40_000, 3)[0])
    assert not np.array_equal(points, sample_surface(vertices, faces, 40_000, 4)[0])


def test_faces_without_area_are_never_sampled():
    vertices, faces = cube()
    faces = np.concatenate([faces[:4], [[0, 0, 0]], faces[4:], [[1, 1, 2]]])
    _, normals = sample_surface(vertices, faces, 5000, 0)
    assert np.isfinite(normals).all() and np.allclose(np.linalg.norm(normals, axis=1), 1)
    with pytest.raises(ValueError, match="no area"):
        sample_surface(vertices, np.array([[0, 0, 0]]), 10, 0)


def test_the_true_mesh_itself_has_no_excess():
    mesh = icosphere()
    row = judge(mesh, truth(mesh))
    assert abs(row.excess) < 0.05 * row.floor
    assert row.point_to_surface < 1e-7 and row.f_score == 1 and row.iou == 1
    assert row.normal_consistency > 0.99 and not row.failed
    flipped = judge((mesh[0], mesh[1][:, ::-1]), truth(mesh))
    assert flipped.normal_consistency > 0.99
    area = 4 * np.pi * 0.6**2
    assert row.floor * 1e3 == pytest.approx(0.021 * area, rel=0.1)


def test_an_offset_is_measured_as_what_it_is():
    row = judge(icosphere(0.62), truth(icosphere(0.6)))
    for value in (row.point_to_surface, row.accuracy, row.completeness, row.accuracy_p95):
        assert value == pytest.approx(0.02, rel=0.05)
    assert row.excess == pytest.approx(2 * 0.02**2, rel=0.15)
    assert row.iou == pytest.approx((0.6 / 0.62) ** 3, abs=0.01)
    assert row.f_score == 0


def test_completeness_sees_a_missing_half_and_accuracy_does_not():
    vertices, faces = icosphere()
    half = faces[vertices[faces].mean(axis=1)[:, 2] > 0]
    row = judge((vertices, half), truth((vertices, faces)))
    assert row.accuracy < 1e-7 and row.completeness > 0.05
    assert row.f_score == pytest.approx(2 / 3, abs=0.02)  # precision 1, recall 1/2
    assert row.iou is None


def test_point_to_surface_agrees_with_the_closed_form_of_a_cube():
    points = np.random.default_rng(0).normal(size=(2000, 3))
    outside = np.abs(points) - 0.5
    exact = np.linalg.norm(outside.clip(min=0), axis=1) + outside.max(axis=1).clip(max=0)
    assert np.allclose(point_to_surface(points, *cube()), np.abs(exact), atol=1e-12)


def test_iou_of_shifted_cubes():
    assert volumetric_iou(cube(), cube(centre=(0.5, 0, 0)), count=200_000) == pytest.approx(1 / 3, abs=0.005)
    assert volumetric_iou(cube(), cube(centre=(3, 0, 0))) == 0


def test_a_box_turned_inside_out_within_another_is_hollow():
    vertices = np.concatenate([cube()[0], cube(0.5)[0]])
    hollow = vertices, np.concatenate([cube()[1], cube(0.5)[1][:, ::-1] + 8])
    assert volumetric_iou(cube(), hollow, count=100_000) == pytest.approx(7 / 8, abs=0.005)
    doubled = np.concatenate([cube()[0]] * 2), np.concatenate([cube()[1], cube()[1] + 8])
    assert volumetric_iou(cube(), doubled) == 1


def test_closed_means_that_edges_cancel():
    vertices, faces = cube()
    assert is_closed(vertices, faces)
    assert is_closed(vertices[faces].reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3))
    assert not is_closed(vertices, faces[1:])
    assert not is_closed(vertices, np.concatenate([faces[:1, ::-1], faces[1:]]))
    assert not is_closed(*EMPTY)


def test_source_frame_scales_chamfer_by_the_square():
    row = judge(icosphere(0.61), truth(icosphere(), scale=0.5))
    assert row.cd_source == pytest.approx(4 * row.cd)


def test_judgement_repeats_with_its_seed():
    again = judge(icosphere(0.61), truth(icosphere()), points=3000, seed=5)
    assert again == judge(icosphere(0.61), truth(icosphere()), points=3000, seed=5)
    assert again.cd != judge(icosphere(0.61), truth(icosphere()), points=3000, seed=6).cd


@pytest.mark.parametrize("case", ["empty", "no_area", "not_finite"])
def test_a_failure_is_a_row(case):
    one_face = np.array([[0, 1, 2]])
    mesh = {
        "empty": EMPTY,
        "no_area": (np.zeros((3, 3)), one_face),
        "not_finite": (np.full((3, 3), np.nan), one_face),
    }[case]
    row = judge(mesh, truth(icosphere()), points=2000)
    assert row.failed and row.vertices == len(mesh[0])
    kept = {"failed", "vertices", "faces", "pieces", "floor", "cd_penalty"}
    assert all(v is None for k, v in dataclasses.asdict(row).items() if k not in kept)
    assert row.cd_penalty == pytest.approx(2 * 0.6**2, rel=0.01)


def crumbs(points: torch.Tensor, side: int = 22) -> torch.Tensor:
    """A field of side^3 balls that float apart."""
    cell = (points + 1) * side / 2
    return ((cell - cell.floor() - 0.5).norm(dim=-1) - 0.3) * 2 / side


def test_ten_thousand_floating_pieces_are_counted_and_judged():
    mesh = mesh_dense(crumbs, resolution=89)
    row = judge(mesh, truth(icosphere()), points=2000)
    assert row.pieces == 22**3 and np.isfinite(row.cd) and not row.failed
    assert judge(icosphere(), truth(icosphere()), points=500).pieces == 1
    assert summarize([row])["pieces"]["mean"] == 22**3


def test_summary_counts_failures_and_says_how_they_enter():
    good = [judge(icosphere(r), truth(icosphere()), points=2000) for r in (0.6, 0.61, 0.62)]
    bad = judge(EMPTY, truth(icosphere()), points=2000)
    summary = summarize([*good, bad])
    values = [row.cd for row in good]
    assert summary["shapes"] == 4 and summary["failed"] == 1 and "origin" in summary["failures"]
    assert summary["cd"] == pytest.approx(
        {"mean": np.mean(values), "median": np.median(values), "p90": np.percentile(values, 90), "count": 3}
    )
    assert summary["cd_mean_with_failures"] == pytest.approx(np.mean([*values, bad.cd_penalty]))
    assert summary["cd_median_with_failures"] > summary["cd"]["median"]


def test_summary_of_failures_alone_has_no_means():
    summary = summarize([judge(EMPTY, truth(icosphere()), points=500)])
    assert summary["failed"] == 1 and summary["cd"] == {"mean": None, "median": None, "p90": None, "count": 0}
    assert summarize([])["shapes"] == 0
