"""Judging in worker processes gives what judging here gives, in the same order."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh

from sdfhub.geometry.metrics import judge
from sdfhub.tasks import evaluate
from sdfhub.tasks.evaluate import Evaluation, judge_all
from tests.test_metrics import EMPTY, icosphere, truth

RADII = (0.5, 0.52, 0.55, 0.6)


@pytest.mark.parametrize("workers", [0, 2])
def test_judging_in_processes_gives_each_shape_the_scores_it_gets_here(monkeypatch, tmp_path, workers):
    monkeypatch.setattr(evaluate, "WORTH_A_PROCESS", 1)
    meshes = [*(icosphere(radius, 3) for radius in RADII), EMPTY]
    monkeypatch.setattr(evaluate, "reconstruct", lambda _, codes, resolution: [meshes[int(codes)]])
    true = truth(icosphere(0.55, 3))
    shapes = [SimpleNamespace(id=f"{i}", mesh=true, scale=2.0, center=np.ones(3), up="z") for i in range(5)]
    roles = [("known", shape, torch.tensor([row])) for row, shape in enumerate(shapes)]
    how = Evaluation(64, 500, None, None, fit=None, fit_together=1, pictures=2, workers=workers)
    judged = judge_all(None, roles, how, tmp_path)
    assert [row.metrics for row in judged] == [judge(mesh, true, points=500) for mesh in meshes]
    assert [row.pictures is not None for row in judged] == [True, True, False, False, False]
    assert sorted(path.stem for path in tmp_path.rglob("*.ply")) == ["0", "1", "2", "3"], "the last is empty"
    written = trimesh.load_mesh(tmp_path / "meshes" / "known" / "2.ply")
    np.testing.assert_allclose(written.vertices, meshes[2][0] / 2 + 1, atol=1e-6)


def test_a_field_of_noise_counts_as_without_a_surface(monkeypatch, tmp_path, capsys):
    vertices, faces = icosphere(0.5, 3)
    crowded = vertices, np.concatenate([faces] * 4)
    monkeypatch.setattr(evaluate, "reconstruct", lambda _, codes, resolution: [crowded])
    shape = SimpleNamespace(id="a", mesh=truth(icosphere(0.5, 3)), scale=1.0, center=np.zeros(3), up="z")
    roles = [("known", shape, torch.tensor([0]))]
    how = {"points": 500, "known": None, "held_out": None, "fit": None, "fit_together": 1, "pictures": 1}
    (row,) = judge_all(None, roles, Evaluation(resolution=8, **how), tmp_path)
    assert row.metrics.failed and row.pictures[1] == "no surface" and not list(tmp_path.rglob("*.ply"))
    assert "a: its field is noise, 5,120 faces" in capsys.readouterr().out
    (row,) = judge_all(None, roles, Evaluation(resolution=9, **how), tmp_path)
    assert not row.metrics.failed
