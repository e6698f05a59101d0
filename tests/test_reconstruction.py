"""Observed shapes: the objective and its derivatives, priors, poses, and that fits find what was observed."""

import math

import numpy as np
import pytest
import torch

from sdfhub.latent.fitting import AdamFit
from sdfhub.latent.observed import Problem, Rows, rows_of, violation
from sdfhub.latent.prior import GaussianPrior, IsotropicPrior, Normal
from sdfhub.latent.reconstruction import DeepSdfFit, MapFit
from sdfhub.latent.similarity import SIZE, PoseRange, small_similarity, turns
from sdfhub.shapes import Observation
from tests.test_fitting import ADAM, decoder  # noqa: F401 - a fixture

MAP = {
    "prior": IsotropicPrior(1.0),
    "weight": 1e-4,
    "weight_partial": 1e-3,
    "random": 2,
    "nearest": 2,
    "probes": 64,
    "refined": 1,
}
MAP |= {"thinning": 4, "steps": 20, "tolerance": 3e-3, "smallest": 1e-3, "blurred": 1e-2, "delta": 0.1}
MAP |= {"damping": 10.0}
POSES = PoseRange(turns=4, tilt=15.0, scale=1.3, shift=0.3)
CODES = torch.randn(6, 4, generator=torch.Generator().manual_seed(0)) * 0.5


def ball(radius: float, surface_only=False, noise=0.0, shift=0.0, count=800) -> Observation:
    """What is seen of a ball: signed samples, or points on it and that the far outside is far."""
    rng = np.random.default_rng(0)
    away = rng.standard_normal((count, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    size = radius + np.where(np.arange(count) % 2, 0, rng.uniform(-0.09, 0.3, count))
    points = (size + noise * rng.standard_normal(count))[:, None] * away + shift
    sdf = size - radius
    low = np.where(sdf < 0, -0.2, sdf) if surface_only else sdf
    bounds = (low.astype(np.float32), sdf.astype(np.float32) if not surface_only else np.maximum(sdf, 0.0))
    none = np.zeros(count, bool)
    return Observation(points.astype(np.float32), bounds[0], bounds[1].astype(np.float32), none, noise)


def rows(*shapes: Observation, smallest=1e-3) -> Rows:
    return rows_of(shapes, smallest, (1e-2, 1e-2), torch.device("cpu"))


def test_a_field_within_its_bounds_violates_nothing(decoder):  # noqa: F811
    seen, codes = rows(ball(0.5)), torch.randn(1, 4)
    field = decoder(seen.points, codes).detach()
    inside = seen._replace(low=field - 0.01, high=field + 0.01)
    assert violation(decoder, codes, inside, 0.1).abs().max() == 0
    above = violation(decoder, codes, seen._replace(low=field + 0.02, high=field + 0.03), 1.0)
    below = violation(decoder, codes, seen._replace(low=field - 0.03, high=field - 0.02), 1.0)
    assert torch.allclose(above, torch.tensor(-0.02), atol=1e-6)
    assert torch.allclose(below, torch.tensor(0.02), atol=1e-6)


def test_unsigned_bounds_take_either_side(decoder):  # noqa: F811
    seen, codes = rows(ball(0.5)), torch.randn(1, 4)
    size = decoder(seen.points, codes).detach().abs()
    either = seen._replace(low=size, high=size, unsigned=torch.ones_like(seen.unsigned))
    assert violation(decoder, codes, either, 1.0).abs().max() < 1e-6


@pytest.mark.parametrize("poses", [None, POSES])
def test_the_quadratic_has_the_objectives_value_and_gradient(decoder, poses):  # noqa: F811
    problem = Problem(decoder, GaussianPrior(0.3)(CODES), 0.1, poses)
    seen = rows(ball(0.5, noise=0.01))
    unknowns = 0.1 * torch.randn(1, len(problem.center), generator=torch.Generator().manual_seed(1))
    turn = torch.tensor([0 if poses is None else 1])

    def objective(at):
        moved, scale = seen.turned(problem.turns[turn]), 1
        if poses:
            pose = small_similarity(at[:, 4:])
            scale = pose.scale
            bounds = {name: getattr(moved, name) * pose.scale for name in ("low", "high")}
            moved = moved._replace(points=pose.moved(moved.points), **bounds)
        size = violation(decoder, at[:, :4], moved, 0.1).abs() / scale
        huber = torch.nn.functional.huber_loss(size, torch.zeros_like(size), delta=0.01) / 0.01
        away = at - problem.center
        return huber + 1e-2 * (away @ problem.precision @ away.mT).sum()

    at = unknowns.clone().requires_grad_()
    value = objective(at)
    (gradient,) = torch.autograd.grad(value, at)
    about = problem.about(seen, turn, unknowns)
    assert torch.allclose(about.value, value, atol=1e-6)
    assert torch.allclose(about.gradient, gradient, atol=1e-5)
    assert torch.linalg.eigvalsh(about.hessian).min() > 0


def test_a_fit_finds_balls_from_samples_and_from_surfaces(decoder):  # noqa: F811
    seen = [ball(0.45), ball(0.52), ball(0.48, surface_only=True), ball(0.5, noise=0.01)]
    found = MapFit(**MAP)(decoder, CODES, seen)
    fresh = [ball(radius, count=900) for radius in (0.45, 0.52, 0.48, 0.5)]
    errors = [
        violation(decoder, code[None], rows(each), 0.1).abs().mean()
        for code, each in zip(found.codes, fresh, strict=True)
    ]
    assert max(errors) < 0.02
    assert found.poses is None and (found.residuals < 0.02).all()


def test_targets_fitted_together_get_what_they_get_alone(decoder, several):  # noqa: F811
    seen, fit = [ball(0.45), ball(0.52, noise=0.01)], MapFit(**MAP)
    together = fit(decoder, CODES, seen)
    for row, one in enumerate(seen):
        alone = fit(decoder, CODES, [one])
        assert torch.equal(together.codes[row], alone.codes[0])
        assert torch.equal(together.residuals[row], alone.residuals[0])


def test_targets_in_one_batch_get_what_they_get_one_by_one(decoder):  # noqa: F811
    seen, fit = [ball(0.45), ball(0.52)], MapFit(**MAP)
    problem = Problem(decoder, fit.prior(CODES), fit.delta, None)
    with torch.no_grad():
        batch = fit._fit(problem, CODES, rows(*seen)._replace(weight=torch.full((2,), 1e-4)))  # as on a GPU
    assert torch.allclose(batch.codes, fit(decoder, CODES, seen).codes, atol=1e-3)


def test_more_starts_never_end_higher(decoder):  # noqa: F811
    """On the rows that starts see, which here are all."""
    seen, how = [ball(0.47)], MAP | {"thinning": 1, "blurred": 1e-3, "tolerance": 1e-5}
    few = MapFit(**how | {"random": 0, "nearest": 0})(decoder, CODES, seen)
    many = MapFit(**how | {"random": 4, "nearest": 4})(decoder, CODES, seen)
    prior = [1e-4 / 4 * found.codes.square().sum() for found in (few, many)]
    assert many.residuals[0] + prior[1] <= few.residuals[0] + prior[0] + 1e-4


def test_an_unknown_pose_is_found(decoder):  # noqa: F811
    shifted = ball(0.5, shift=np.array([0.12, -0.08, 0.1]))
    found = MapFit(**MAP)(decoder, CODES, [shifted], POSES)
    centre = torch.tensor([[[0.12, -0.08, 0.1]]])
    assert found.poses.moved(centre).abs().max() < 0.02
    assert found.residuals[0] < 0.02


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


def test_the_gaussian_prior_is_the_codes_and_never_flat():
    codes = torch.randn(500, 3) * torch.tensor([1.0, 2.0, 3.0])
    mean, covariance = GaussianPrior(1e-4)(codes)
    assert torch.allclose(mean, codes.mean(0)) and torch.allclose(covariance, torch.cov(codes.T), atol=1e-3)
    few = GaussianPrior(0.1)(torch.randn(3, 8))
    assert torch.linalg.eigvalsh(few.covariance).min() > 0
    assert torch.linalg.eigvalsh(GaussianPrior(0.1)(torch.ones(1, 8)).covariance).min() > 0
    assert GaussianPrior(1e-4)(torch.randn(20, 64) / 8).draw(2, seed=0).isfinite().all()
    with pytest.raises(ValueError, match="shrinkage"):
        GaussianPrior(1e-7)


def test_a_code_is_unusual_by_its_distance_to_the_mean():
    codes = torch.randn(50, 4, generator=torch.Generator().manual_seed(0)) * torch.tensor(
        [1.0, 2.0, 3.0, 0.5]
    )
    normal = GaussianPrior(0.1)(codes)
    assert normal.unusual(codes).mean() == pytest.approx(49 / 50)
    assert normal.unusual(normal.mean[None]) == 0
    assert abs(normal.unusual(normal.draw(4000, seed=1)).mean() - 1) < 0.05


def test_draws_follow_the_prior_and_their_seed():
    normal = Normal(torch.tensor([1.0, -2.0]), torch.tensor([[2.0, 0.5], [0.5, 1.0]]))
    drawn = normal.draw(20_000, 0)
    assert torch.allclose(drawn.mean(0), normal.mean, atol=0.05)
    assert torch.allclose(torch.cov(drawn.T), normal.covariance, atol=0.06)
    assert torch.equal(normal.draw(5, 1), normal.draw(5, 1))


def test_deepsdfs_recipe_takes_samples_and_nothing_else(decoder):  # noqa: F811
    rival = DeepSdfFit(AdamFit(**ADAM))
    found = rival(decoder, CODES, [ball(0.5)])
    assert found.residuals[0] < 0.02
    vague = ball(0.5)
    vague = Observation(vague.points, vague.low, vague.high + np.float32(0.1), vague.unsigned)
    with pytest.raises(ValueError, match="signed samples"):
        rival(decoder, CODES, [vague])
    seen = ball(0.5)
    seen = Observation(seen.points, 0 * seen.low, 0 * seen.high, seen.unsigned)
    with pytest.raises(ValueError, match="signed samples"):
        rival(decoder, CODES, [seen])
    with pytest.raises(ValueError, match="poses"):
        rival(decoder, CODES, [ball(0.5)], POSES)


@pytest.mark.parametrize("wrong", [{"probes": 0}, {"nearest": -1}, {"delta": 0.0}])
def test_settings_out_of_range_are_refused(wrong):
    with pytest.raises(ValueError, match="must"):
        MapFit(**MAP | wrong)


def test_an_observation_refuses_what_is_none():
    whole = ball(0.5)
    parts = [whole.points, whole.low, whole.high, whole.unsigned]
    with pytest.raises(ValueError, match="above"):
        Observation(parts[0], parts[2] + np.float32(1), parts[2], parts[3])
    with pytest.raises(ValueError, match="finite"):
        Observation(parts[0] * np.float32("nan"), *parts[1:])
    with pytest.raises(ValueError, match="noise"):
        Observation(*parts, noise=-1.0)
