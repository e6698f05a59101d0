"""Judging in worker processes gives what judging here gives, in the same order."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from sdfhub.geometry.metrics import judge
from sdfhub.tasks import evaluate
from sdfhub.tasks.evaluate import Evaluation, judge_all
from tests.test_metrics import EMPTY, icosphere, truth

RADII = (0.5, 0.52, 0.55, 0.6)


@pytest.mark.parametrize("workers", [0, 2])
def test_judging_in_processes_gives_each_shape_the_scores_it_gets_here(monkeypatch, workers):
    monkeypatch.setattr(evaluate, "WORTH_A_PROCESS", 1)
    meshes = [*(icosphere(radius, 3) for radius in RADII), EMPTY]
    monkeypatch.setattr(evaluate, "reconstruct", lambda _, codes, resolution: [meshes[int(codes)]])
    shape = SimpleNamespace(mesh=truth(icosphere(0.55, 3)))
    how = Evaluation(16, 500, None, None, fit=None, fit_together=1, pictures=0, workers=workers)
    judged = judge_all(None, [("known", shape, torch.tensor([row])) for row in range(len(meshes))], how)
    assert [row.metrics for row in judged] == [judge(mesh, shape.mesh, points=500) for mesh in meshes]
    assert all(np.array_equal(row.vertices, mesh[0]) for row, mesh in zip(judged, meshes, strict=True))
