"""Judging in worker processes gives what judging here gives; noise and missing surfaces are counted."""

import csv
import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from sdfhub.evaluation import judging
from sdfhub.evaluation.judging import Evaluation, judge_all
from sdfhub.evaluation.scoresheet import Judged, table, write_scores, write_sheet
from sdfhub.geometry.metrics import DistanceMetrics, judge
from sdfhub.latent.gauss_newton import GaussNewtonFit
from sdfhub.shapes import Frame, Mesh
from tests.test_metrics import EMPTY, icosphere, truth

RADII = (0.5, 0.52, 0.55, 0.6)


def settings(**changes) -> Evaluation:
    defaults = {"resolution": 64, "points": 500, "train": None, "held_out": None, "fit": GaussNewtonFit()}
    return Evaluation(**defaults | {"fit_together": 1, "pictures": 2} | changes)


def shapes(count: int) -> list[SimpleNamespace]:
    mesh = truth(icosphere(0.55, 3))
    return [
        SimpleNamespace(id=f"{row}", mesh=mesh, frame=Frame(np.ones(3), 2.0), up="z") for row in range(count)
    ]


@pytest.mark.parametrize("workers", [0, 2])
def test_judging_in_processes_gives_each_shape_the_scores_it_gets_here(monkeypatch, tmp_path, workers):
    monkeypatch.setattr(judging, "WORTH_A_PROCESS", 1)
    meshes = [Mesh(*pair) for pair in (*(icosphere(radius, 3) for radius in RADII), EMPTY)]
    monkeypatch.setattr(judging, "reconstruct", lambda _, codes, resolution: [meshes[int(codes)]])
    roles = [("train", shape, torch.tensor([row])) for row, shape in enumerate(shapes(5))]
    judged = judge_all(None, roles, settings(workers=workers), tmp_path)
    assert [row.metrics for row in judged] == [judge(mesh, roles[0][1].mesh, points=500) for mesh in meshes]
    assert [row.pictures is not None for row in judged] == [True, True, False, False, False]
    assert sorted(path.stem for path in tmp_path.rglob("*.ply")) == ["0", "1", "2", "3"], "the last is empty"
    written = trimesh.load_mesh(tmp_path / "meshes" / "train" / "2.ply")
    np.testing.assert_allclose(written.vertices, meshes[2][0] / 2 + 1, atol=1e-6)


def test_a_field_of_noise_counts_as_without_a_surface(monkeypatch, tmp_path, caplog):
    vertices, faces = icosphere(0.5, 3)
    crowded = Mesh(vertices, np.concatenate([faces] * 4))
    monkeypatch.setattr(judging, "reconstruct", lambda _, codes, resolution: [crowded])
    roles = [("train", shapes(1)[0], torch.tensor([0]))]
    (row,) = judge_all(None, roles, settings(resolution=8), tmp_path)
    assert row.metrics.failed and row.pictures[1] == "no surface" and not list(tmp_path.rglob("*.ply"))
    assert "0: its field is noise, 5,120 faces" in caplog.text
    (row,) = judge_all(None, roles, settings(resolution=9), tmp_path)
    assert not row.metrics.failed


def test_scores_are_written_and_a_missing_surface_is_counted_apart(tmp_path):
    of = shapes(3)
    metrics = [judge(mesh, of[0].mesh, points=500) for mesh in (icosphere(0.5), icosphere(0.6), EMPTY)]
    judged = [Judged("train", shape, row) for shape, row in zip(of, metrics, strict=True)]
    judged += [Judged("held_out", of[0], metrics[0])]
    result = write_scores(judged, settings(), {"steps": 7}, tmp_path)
    assert json.loads((tmp_path / "metrics.json").read_text()) == result and result["training"] == {
        "steps": 7
    }
    assert result["train"]["summary"]["failed"] == 1 and result["train"]["shapes"][2]["cd"] is None
    rows = list(csv.DictReader((tmp_path / "metrics.csv").open()))
    assert float(rows[1]["cd"]) == metrics[1].cd and rows[2]["cd"] == "" and rows[3]["role"] == "held_out"
    text = table(judged)
    assert f"{1e3 * (metrics[0].cd + metrics[1].cd) / 2:.4f}" in text, "the mean of those with a surface"
    assert "without surface: 1 of 3" in text and "held-out shapes" in text


def test_shapes_without_meshes_have_scores_of_their_distances(tmp_path, caplog):
    caplog.set_level("INFO")
    rows = [DistanceMetrics(0.01, 0.9), DistanceMetrics(0.03, 1.0)]
    judged = [Judged("train", shape, row) for shape, row in zip(shapes(2), rows, strict=True)]
    result = write_scores(judged, settings(), None, tmp_path)
    assert result["train"]["summary"]["sdf_error"]["mean"] == pytest.approx(0.02)
    assert result["train"]["shapes"][1] == {"id": "1", "sdf_error": 0.03, "sign_accuracy": 1.0}
    assert "judged by signed distances" in caplog.text and "20.0000" in table(judged)


def test_shapes_of_a_role_lie_in_a_band_of_the_sheet(tmp_path):
    red, blue = (np.full((40, 40, 3), colour, np.uint8) for colour in ([200, 30, 30], [30, 30, 200]))
    roles = ["train"] * 3 + ["held_out"]
    metrics = judge(Mesh(*icosphere(0.5, 3)), truth(icosphere(0.55, 3)), 500)
    shown = [Judged(role, shape, metrics, (red, blue)) for role, shape in zip(roles, shapes(4), strict=True)]
    write_sheet(shown, tmp_path / "s.png")
    page = np.asarray(Image.open(tmp_path / "s.png")).astype(int)
    widths = [(page == colour).all(axis=-1).sum(axis=1) for colour in ([200, 30, 30], [30, 30, 200])]
    bands = np.select([widths[0] > 0, widths[1] > 0], [widths[0], -widths[1]])
    assert [*bands[np.flatnonzero(np.diff(bands, prepend=0))]] == [120, 0, -120, 0, 40, 0, -40, 0]


@pytest.mark.parametrize("wrong", [{"resolution": 1}, {"points": 0}, {"fit_together": 0}, {"pictures": -1}])
def test_settings_out_of_range_are_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        settings(**wrong)
