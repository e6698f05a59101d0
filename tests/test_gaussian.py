"""Gaussians over codes, poses, and what an observation refuses."""

import math

import numpy as np
import pytest
import torch

from sdfhub.latent.gaussian import Gaussian
from sdfhub.latent.similarity import SIZE, small_similarity, turns
from sdfhub.shapes import Observation
from tests.test_fitting import POSES, ball


def test_a_range_of_poses_holds_what_it_says():
    inside, outside = torch.zeros(6, SIZE), torch.zeros(3, SIZE)
    inside[:, 3] = torch.arange(6)  # any turn about the upright axis
    inside[0, 0], inside[1, 1], inside[2, 4] = 0.25, 0.25, -0.29
    inside[1, 3] = 0.0
    outside[0, 0], outside[1, 1], outside[2, 4] = -0.27, 0.27, 0.31
    assert POSES.holds(small_similarity(inside)).all()
    assert not POSES.holds(small_similarity(outside)).any()


def test_small_similarities_are_similarities():
    numbers = torch.randn(5, SIZE, generator=torch.Generator().manual_seed(0))
    found = small_similarity(numbers)
    assert torch.allclose(found.rotation @ found.rotation.mT, torch.eye(3).expand(5, 3, 3), atol=1e-5)
    assert torch.allclose(torch.linalg.det(found.rotation), torch.ones(5), atol=1e-5)
    assert torch.allclose(found.scale, numbers[:, 0].exp())
    nothing = torch.zeros(1, SIZE, requires_grad=True)
    (slope,) = torch.autograd.grad(small_similarity(nothing).moved(torch.rand(1, 4, 3)).sum(), nothing)
    assert torch.isfinite(slope).all() and torch.equal(small_similarity(nothing).rotation[0], torch.eye(3))


@pytest.mark.parametrize(("up", "axis"), [("y", 1), ("z", 2)])
def test_turns_leave_the_upright_axis_and_go_all_around(up, axis):
    found = turns(8, up)
    assert torch.allclose(found[:, :, axis], torch.eye(3)[axis].expand(8, 3), atol=1e-6)
    assert torch.allclose(found[2] @ found[6], torch.eye(3), atol=1e-6)
    apart = torch.einsum("aij,bij->ab", found, found)  # 1 + 2 cos of the angle between
    assert torch.allclose(apart[0, 1:].max(), torch.tensor(1 + 2 * math.cos(math.pi / 4)), atol=1e-5)


def test_a_gaussian_is_the_codes_and_with_shrinkage_never_flat():
    codes = torch.randn(500, 3) * torch.tensor([1.0, 2.0, 3.0])
    plain = Gaussian.of(codes)
    assert torch.allclose(plain.mean, codes.mean(0))
    assert torch.allclose(plain.covariance, torch.cov(codes.T), atol=1e-3)
    shrunk = 0.75 * torch.cov(codes.T) + 0.25 * torch.cov(codes.T).trace() / 3 * torch.eye(3)
    assert torch.allclose(Gaussian.of(codes, 0.25).covariance, shrunk, atol=1e-3)
    for few in (torch.randn(3, 8), torch.ones(1, 8)):
        assert torch.linalg.eigvalsh(Gaussian.of(few, 0.1).covariance).min() > 0
    assert Gaussian.of(codes[:1]).sample(2).equal(codes[:1].expand(2, -1))


@pytest.mark.parametrize("shrinkage", [0.0, 0.2])
def test_samples_follow_the_distribution_and_their_seed(shrinkage):
    codes = torch.randn(400, 3) @ torch.tensor([[2.0, 0.3, 0.0], [0.0, 0.5, 0.1], [0.0, 0.0, 0.1]]) + 5
    gaussian = Gaussian.of(codes, shrinkage)
    drawn = gaussian.sample(40_000, seed=3)
    assert torch.allclose(drawn.mean(0), gaussian.mean, atol=0.03)
    assert torch.allclose(torch.cov(drawn.T), gaussian.covariance, atol=0.1)
    assert torch.equal(drawn, gaussian.sample(40_000, seed=3))
    assert torch.allclose(
        torch.cov(Gaussian.isotropic(codes[0], 2.0).sample(40_000).T), 4 * torch.eye(3), atol=0.1
    )


def test_a_code_is_unusual_by_its_distance_to_the_mean():
    codes = torch.randn(50, 4, generator=torch.Generator().manual_seed(0)) * torch.tensor(
        [1.0, 2.0, 3.0, 0.5]
    )
    gaussian = Gaussian.of(codes, 0.1)
    assert gaussian.unusual(codes).mean() == pytest.approx(49 / 50)
    assert gaussian.unusual(gaussian.mean[None]) == 0
    assert abs(gaussian.unusual(gaussian.sample(4000, seed=1)).mean() - 1) < 0.05


def test_an_observation_refuses_what_is_none():
    whole = ball(0.5)
    parts = [whole.points, whole.low, whole.high, whole.unsigned]
    with pytest.raises(ValueError, match="above"):
        Observation(parts[0], parts[2] + np.float32(1), parts[2], parts[3])
    with pytest.raises(ValueError, match="finite"):
        Observation(parts[0] * np.float32("nan"), *parts[1:])
    with pytest.raises(ValueError, match="noise"):
        Observation(*parts, noise=-1.0)
