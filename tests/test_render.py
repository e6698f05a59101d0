"""Properties of the pictures: what is seen is the shape, both of its sides, and the page is whole."""

import os

import numpy as np
import pytest
import trimesh
from PIL import Image

from sdfhub.geometry.picture_file import contact_sheet
from sdfhub.geometry.render import render, slice_image


@pytest.fixture(scope="module")
def ball() -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=3, radius=0.97)


def test_an_empty_mesh_is_background():
    image = render(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64), 32)
    assert image.shape == (32, 32, 3) and image.dtype == np.uint8
    assert (image == 255).all()


def test_the_unit_ball_fills_the_frame_and_leaves_the_corners(ball):
    image = render(ball.vertices, ball.faces, 64)
    seen = (image < 250).any(axis=-1)
    assert seen.mean() == pytest.approx(np.pi / 4 * 0.97**2, abs=0.03)
    assert not seen[[0, 0, -1, -1], [0, -1, 0, -1]].any()


def test_flipped_faces_look_the_same(ball):
    image = render(ball.vertices, ball.faces, 48)
    flipped = render(ball.vertices, ball.faces[:, ::-1], 48)
    assert np.abs(image.astype(int) - flipped).mean() < 0.5


def test_up_is_up_and_lit_from_above(ball):
    raised = render(ball.vertices * 0.3 + [0, 0, 0.6], ball.faces, 64)
    rows = np.flatnonzero((raised < 250).any(axis=(1, 2)))
    assert rows.max() < 32
    whole = render(ball.vertices, ball.faces, 64).astype(int).sum(axis=-1)
    assert whole[12, 32] > 1.3 * whole[52, 32]


def test_a_roof_darkens_what_is_under_it():
    floor = trimesh.creation.box((1.2, 1.2, 0.05)).apply_translation((0, 0, -0.3))
    roof = trimesh.creation.box((1.2, 1.2, 0.05)).apply_translation((0, 0, 0.3))
    alone = render(floor.vertices, floor.faces, 64, elevation=10)
    both = trimesh.util.concatenate([floor, roof])
    covered = render(both.vertices, both.faces, 64, elevation=10)
    top = (alone < 250).any(axis=-1) & (np.arange(64)[:, None] > 36)
    assert covered[top].mean() < 0.9 * alone[top].mean()


def test_flat_faces_stay_flat_and_round_ones_become_smooth(ball):
    cube = trimesh.creation.box((1, 1, 1))
    image = render(cube.vertices, cube.faces, 64)
    assert len(np.unique(image.reshape(-1, 3), axis=0)) < 0.15 * 64 * 64  # three tones and their seams
    coarse = trimesh.creation.icosphere(subdivisions=2, radius=0.97)
    smooth = render(coarse.vertices, coarse.faces, 64)[:, 32].astype(int)
    fine = render(ball.vertices, ball.faces, 64)[:, 32].astype(int)
    assert np.abs(smooth - fine)[8:56].max() < 16


def test_a_slice_is_blue_inside_orange_outside_and_black_at_zero():
    grid = np.linspace(-1, 1, 65)
    x, y = np.meshgrid(grid, grid, indexing="ij")
    image = slice_image(np.hypot(x, y - 0.2) - 0.5, 0.1).astype(int)
    assert image.shape == (65, 65, 3)
    inside, outside = image[26, 32], image[2, 2]  # the circle's centre lies above the middle
    assert inside[2] > inside[0] and outside[0] > outside[2]
    assert (image == 0).all(axis=-1).sum() > 40


def test_a_slice_with_holes_in_it_still_draws():
    assert slice_image(np.full((8, 8), np.nan), 0.1).shape == (8, 8, 3)


def test_a_contact_sheet_shows_every_cell_and_says_where_a_surface_is_missing(tmp_path):
    red = np.zeros((40, 40, 3), np.uint8) + np.uint8([200, 30, 30])
    path = contact_sheet(
        [[red, "no surface"], ["no surface", red]],
        ["truth", "ours"],
        ["a", "b" * 90],
        tmp_path / "x" / "s.png",
    )
    page = np.asarray(Image.open(path)).astype(int)
    assert (page == [200, 30, 30]).all(axis=-1).sum() == 2 * 40 * 40
    assert (page == [243, 243, 245]).all(axis=-1).any()
    assert os.listdir(path.parent) == ["s.png"]


def test_a_contact_sheet_of_several_rows_can_name_every_picture(tmp_path):
    red = np.zeros((40, 40, 3), np.uint8) + np.uint8([200, 30, 30])
    rows = [[red, red], [red]]
    heights = {}
    for captions in (["a", "b"], ["a", "b", "c"]):
        page = np.asarray(Image.open(contact_sheet(rows, [], captions, tmp_path / "s.png"))).astype(int)
        assert (page == [200, 30, 30]).all(axis=-1).sum() == 3 * 40 * 40
        heights[len(captions)] = len(page)
    dark = (page < 120).all(axis=-1)
    second_row = (page == [200, 30, 30]).all(axis=-1)[:, 10].nonzero()[0][40]
    assert heights[3] > heights[2] and dark[second_row - 20 : second_row, :50].any(), "the third one's name"


def test_a_contact_sheet_is_written_whole_or_not_at_all(tmp_path, monkeypatch):
    def full_disc(*_):
        raise OSError("no space")

    monkeypatch.setattr(os, "replace", full_disc)
    with pytest.raises(OSError, match="no space"):
        contact_sheet([["no surface"]], [], [], tmp_path / "s.png")
    assert os.listdir(tmp_path) == []


def test_a_mesh_with_y_up_is_turned_upright():
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.2)
    high = np.asarray(ball.vertices)[:, [0, 1, 2]] + [0, 0.5, 0]
    standing = np.column_stack([high[:, 0], -high[:, 2], high[:, 1]])
    assert np.array_equal(render(high, ball.faces, 64, up="y"), render(standing, ball.faces, 64))
    rows = np.flatnonzero((render(high, ball.faces, 64, up="y") < 250).any(axis=(1, 2)))
    assert rows.max() < 40


@pytest.mark.parametrize("size, place", [(1e-5, 0.0), (0.1, 50.0), (0.0, 0.2)])
def test_what_no_ray_hits_leaves_the_background(size, place, ball):
    """A crumb, a mesh out of view, and one without area."""
    image = render(ball.vertices * size + place, ball.faces, 32)
    assert (image == 255).all()
