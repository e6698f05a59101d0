"""Codes of observed shapes: both ways of finding them, on a family of balls with a trained decoder."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from sdfhub.errors import SdfhubError
from sdfhub.latent.deepsdf_fit import DeepSdfFit
from sdfhub.latent.fitting import frozen
from sdfhub.latent.gauss_newton import GaussNewtonFit, in_groups
from sdfhub.latent.gaussian import Gaussian
from sdfhub.latent.problem import Problem, Rows, violation
from sdfhub.latent.similarity import PoseRange, small_similarity
from sdfhub.model.losses import clamped_l1
from sdfhub.scans.evidence import Evidence
from sdfhub.scans.observed_scan import observations_of
from sdfhub.shapes import Observation
from tests.test_model import small_decoder
from tests.test_training import FakeShape, batches

DELTA = 0.1
NEWTON = GaussNewtonFit(samples=800, random=2, nearest=2, probes=64, thinning=4, steps=20)
ADAM = DeepSdfFit(steps=100, lr=2e-2, per_step=256)
FIT_FILES = ("fit/gauss_newton.yaml", "fit/deepsdf.yaml")
FITS = {"gauss_newton": NEWTON, "deepsdf": ADAM}
POSES = PoseRange(turns=4, tilt=15.0, scale=1.3, shift=0.3)
CODES = torch.randn(6, 4, generator=torch.Generator().manual_seed(0)) * 0.5


@pytest.fixture(scope="module")
def decoder():
    """Trained on four balls of radius 0.4 to 0.55."""
    torch.manual_seed(0)
    decoder, codes = small_decoder(width=32), torch.nn.Parameter(torch.randn(4, 4) * 0.5)
    stream = batches(shapes=4, per_step=4, samples=256, surface=0)
    optimizer = torch.optim.Adam([*decoder.parameters(), codes], lr=5e-3)
    for step in range(250):
        batch = stream[step]
        loss = clamped_l1(decoder(batch.points, codes[batch.rows]), batch.sdf, DELTA)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return decoder


def ball(radius: float, surface_only=False, noise=0.0, shift=0.0, count=800) -> Observation:
    """Signed samples of a ball, or points on it and that the far outside is far."""
    rng = np.random.default_rng(0)
    away = rng.standard_normal((count, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    size = radius + np.where(np.arange(count) % 2, 0, rng.uniform(-0.09, 0.3, count))
    points = (size + noise * rng.standard_normal(count))[:, None] * away + shift
    sdf = size - radius
    low = np.where(sdf < 0, -0.2, sdf) if surface_only else sdf
    high = np.maximum(sdf, 0.0) if surface_only else sdf
    parts = (part.astype(np.float32) for part in (points, low, high))
    return Observation(*parts, np.zeros(count, bool), noise)


def rows(*shapes: Observation, smallest=1e-3, prior=1) -> Rows:
    return Rows.of(shapes, smallest, [prior] * len(shapes), torch.device("cpu"))


def error(decoder, code, observation) -> float:
    with torch.no_grad(), frozen(decoder):
        return float(violation(decoder, code[None], rows(observation), DELTA).abs().mean())


@pytest.mark.parametrize("fit", FITS.values(), ids=FITS)
def test_a_fit_finds_codes_of_unseen_shapes_and_leaves_the_decoder_alone(decoder, fit):
    decoder.train()
    before = {name: value.clone() for name, value in decoder.state_dict().items()}
    fitted = fit(decoder, CODES, [ball(0.47), ball(0.52)], DELTA)
    for code, radius in zip(fitted.codes, (0.47, 0.52), strict=True):
        away = error(decoder, code, ball(radius, count=900))
        assert away < 0.01 and away < 0.5 * error(decoder, torch.zeros(4), ball(radius))
    assert all(torch.equal(before[name], value) for name, value in decoder.state_dict().items())
    assert all(parameter.requires_grad for parameter in decoder.parameters()) and decoder.training
    assert not fitted.codes.requires_grad and fitted.poses is None and (fitted.residuals < 0.02).all()


def test_the_surface_of_a_ball_is_enough(decoder):
    seen = [ball(0.48, surface_only=True), ball(0.5, noise=0.01)]
    fitted = NEWTON(decoder, CODES, seen, DELTA)
    assert max(map(error, [decoder] * 2, fitted.codes, [ball(0.48), ball(0.5)])) < 0.02


@pytest.mark.parametrize(("name", "tolerance"), [("deepsdf", 1e-4), ("gauss_newton", 0)])
def test_shapes_fitted_together_get_what_they_get_alone(decoder, several, name, tolerance):
    seen, fit = [ball(0.45), ball(0.52, noise=0.01), ball(0.5, count=600)], FITS[name]
    together = fit(decoder, CODES, seen, DELTA)
    for row, observation in enumerate(seen):
        alone = fit(decoder, CODES, [observation], DELTA)
        assert torch.allclose(together.codes[row], alone.codes[0], rtol=0, atol=tolerance)
        assert torch.allclose(together.residuals[row], alone.residuals[0], rtol=0, atol=tolerance)


def test_shapes_in_one_batch_get_what_they_get_one_by_one(decoder, monkeypatch):
    seen = [ball(0.45), ball(0.5, count=600), ball(0.52)]
    one_by_one = NEWTON(decoder, CODES, seen, DELTA)
    elsewhere = lambda fit, seen, _: in_groups(fit, seen, torch.device("meta"))  # noqa: E731
    monkeypatch.setattr("sdfhub.latent.gauss_newton.in_groups", elsewhere)
    batch = NEWTON(decoder, CODES, seen, DELTA)
    assert torch.allclose(batch.codes, one_by_one.codes, atol=1e-3)


def test_a_shape_without_numbers_does_not_harm_its_neighbour(decoder):
    broken = ball(0.45)
    broken.points[:] = np.nan
    fitted = NEWTON(decoder, CODES, [broken, ball(0.5)], DELTA)
    assert torch.equal(fitted.codes[1], NEWTON(decoder, CODES, [ball(0.5)], DELTA).codes[0])


def test_gauss_newton_reaches_adams_minimum(decoder):
    long = replace(ADAM, steps=250)

    def objective(code, observation):
        return error(decoder, code, observation) + 1e-4 * float(code.square().mean())

    for radius in (0.43, 0.47, 0.52, 0.54):
        fresh = ball(radius, count=2000)
        quick, slow = (fit(decoder, CODES, [ball(radius)], DELTA).codes[0] for fit in (NEWTON, long))
        assert objective(quick, fresh) < 1.05 * objective(slow, fresh) + 1e-4


def test_more_starts_never_end_higher(decoder):
    """On the rows that starts see, which here are all."""
    how = replace(NEWTON, thinning=1, blurred=1e-3, tolerance=1e-5)
    seen, flat = [ball(0.47, surface_only=True)], replace(how, weight=0.0)
    few = replace(flat, random=0, nearest=0)(decoder, CODES, seen, DELTA)
    many = replace(flat, random=4, nearest=4)(decoder, CODES, seen, DELTA)
    assert many.residuals[0] <= few.residuals[0] + 1e-4


def test_an_unknown_pose_is_found(decoder):
    shifted = ball(0.5, shift=np.array([0.12, -0.08, 0.1]))
    fitted = NEWTON(decoder, CODES, [shifted], DELTA, POSES)
    centre = torch.tensor([[[0.12, -0.08, 0.1]]])
    assert fitted.poses.moved(centre).abs().max() < 0.02
    assert fitted.residuals[0] < 0.02


def test_deepsdfs_recipe_takes_samples_and_nothing_else(decoder):
    whole = ball(0.5)
    vague = replace(whole, high=whole.high + np.float32(0.1))
    surface = replace(whole, low=0 * whole.low, high=0 * whole.high)
    for observation in (vague, surface):
        with pytest.raises(SdfhubError, match="signed samples"):
            ADAM(decoder, CODES, [observation], DELTA)
    with pytest.raises(SdfhubError, match="poses"):
        ADAM(decoder, CODES, [whole], DELTA, POSES)


def test_a_field_within_its_bounds_violates_nothing(decoder):
    seen, codes = rows(ball(0.5)), torch.randn(1, 4)
    field = decoder(seen.points, codes).detach()
    inside = seen._replace(low=field - 0.01, high=field + 0.01)
    assert violation(decoder, codes, inside, 0.1).abs().max() == 0
    above = violation(decoder, codes, seen._replace(low=field + 0.02, high=field + 0.03), 1.0)
    below = violation(decoder, codes, seen._replace(low=field - 0.03, high=field - 0.02), 1.0)
    assert torch.allclose(above, torch.tensor(-0.02), atol=1e-6)
    assert torch.allclose(below, torch.tensor(0.02), atol=1e-6)


def test_unsigned_bounds_take_either_side(decoder):
    seen, codes = rows(ball(0.5)), torch.randn(1, 4)
    size = decoder(seen.points, codes).detach().abs()
    either = seen._replace(low=size, high=size, unsigned=torch.ones_like(seen.unsigned))
    assert violation(decoder, codes, either, 1.0).abs().max() < 1e-6


@pytest.mark.parametrize("poses", [None, POSES])
def test_the_quadratic_has_the_objectives_value_and_gradient(decoder, poses):
    """By a plain forward pass and autograd, for each of two priors."""
    priors = [(Gaussian.of(CODES, 0.3), 1e-2), (Gaussian.isotropic(CODES[0], 2.0), 1e-3)]
    problem = Problem(decoder, priors, DELTA, poses)
    seen = Rows.of([ball(0.5, noise=0.01)] * 2, 1e-3, [0, 1], torch.device("cpu"))
    unknowns = 0.1 * torch.randn(2, problem.center.shape[1], generator=torch.Generator().manual_seed(1))
    turn = torch.tensor([0, 0 if poses is None else 1])

    def objective(at):
        moved, scale = seen.turned(problem.turns[turn]), 1
        if poses:
            pose = small_similarity(at[:, 4:])
            scale = pose.scale[:, None]
            bounds = {name: getattr(moved, name) * scale for name in ("low", "high")}
            moved = moved._replace(points=pose.moved(moved.points), **bounds)
        size = violation(decoder, at[:, :4], moved, DELTA).abs() / scale
        huber = torch.nn.functional.huber_loss(size, torch.zeros_like(size), delta=0.01, reduction="none")
        pull = []
        for away, (prior, weight) in zip(at, priors, strict=True):
            precision = torch.linalg.inv(prior.covariance)
            code = away[:4] - prior.mean
            spread = (away[4:] / poses.spread()).square().sum() if poses else 0
            pull.append(weight / 4 * (code @ precision @ code + spread))
        return huber.mean(1) / 0.01 + torch.stack(pull)

    at = unknowns.clone().requires_grad_()
    value = objective(at)
    (gradient,) = torch.autograd.grad(value.sum(), at)
    about, slope, hessian = problem.about(seen, turn, unknowns)
    assert torch.allclose(about, value, atol=1e-6)
    assert torch.allclose(slope, gradient, atol=1e-5)
    assert torch.linalg.eigvalsh(hessian).min() > 0


def test_the_observation_of_a_stored_shape_is_the_same_in_any_company():
    shapes = [FakeShape(0.45), FakeShape(0.5)]
    both = observations_of(shapes, 200, [3, 4])
    (alone,) = observations_of(shapes[1:], 200, [4])
    assert all(observation.is_exact for observation in both)
    assert np.array_equal(both[1].points, alone.points) and (alone.low < 0).sum() == 100
    (whole,) = observations_of(shapes[:1], None, [0])
    assert len(whole.points) == len(shapes[0].read("outside")) + len(shapes[0].read("inside"))


@pytest.mark.parametrize(
    ("fit", "wrong"),
    [
        (NEWTON, {"probes": 0}),
        (NEWTON, {"nearest": -1}),
        (NEWTON, {"damping": 0.0}),
        (NEWTON, {"shrinkage": 1e-7}),
        (ADAM, {"steps": 0}),
        (ADAM, {"lr": 0.0}),
    ],
)
def test_settings_out_of_range_are_refused(fit, wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        replace(fit, **wrong)


def test_a_space_fits_as_the_configs_say():
    """Opened from a file that knows no conf/, a space has the same defaults."""
    conf = Path(__file__).parents[1] / "conf"
    nodes = [
        yaml.safe_load((conf / name).read_text()) for name in ("fit/gauss_newton.yaml", "reconstruct.yaml")
    ]
    for node, plain in zip((nodes[0], nodes[1]["evidence"]), (GaussNewtonFit(), Evidence()), strict=True):
        assert type(plain)(**{key: value for key, value in node.items() if key != "_target_"}) == plain
    published = yaml.safe_load((conf / "fit" / "deepsdf.yaml").read_text())
    assert DeepSdfFit(**{key: value for key, value in published.items() if key != "_target_"}) == DeepSdfFit()
