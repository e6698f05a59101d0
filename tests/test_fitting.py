"""Codes of unseen shapes: both ways of finding them, on a family of balls with a trained decoder."""

import numpy as np
import pytest
import torch

from sdfhub.latent.fitting import AdamFit, GaussNewtonFit, field_and_jacobian, initial_codes
from sdfhub.model.losses import clamped_l1
from tests.test_model import small_decoder
from tests.test_training import FakeShape, batches

ADAM = {"steps": 100, "lr": 2e-2, "samples": 256, "spread": 0.01, "lambda_code": 1e-4, "delta": 0.1}
NEWTON = {"steps": 20, "samples": 512, "thinning": 4, "tolerance": 3e-3, "smallest": 1e-3, "damping": 10.0}
NEWTON |= {"spread": 0.01, "lambda_code": 1e-4, "delta": 0.1}
FITS = {"adam": AdamFit(**ADAM), "gauss_newton": GaussNewtonFit(**NEWTON)}


@pytest.fixture(scope="module")
def decoder():
    """Trained on four balls of radius 0.4 to 0.55."""
    torch.manual_seed(0)
    decoder, codes = small_decoder(width=32), torch.nn.Parameter(torch.randn(4, 4) * 0.5)
    stream = batches(shapes=4, per_step=4, samples=256, surface=0)
    optimizer = torch.optim.Adam([*decoder.parameters(), codes], lr=5e-3)
    for step in range(250):
        batch = stream[step]
        loss = clamped_l1(decoder(batch.points, codes[batch.rows]), batch.sdf, 0.1)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return decoder


def draws(*radii: float, samples: int = 512):
    """What a fit asks for: a step's points [B, N, 3] and distances [B, N] of unseen balls, half inside."""

    balls = [FakeShape(radius) for radius in radii]

    def draw(step: int):
        chosen = [np.random.default_rng((step, side)).integers(0, 400, samples // 2) for side in range(2)]
        rows = [np.concatenate([b.outside[chosen[0]], b.inside[chosen[1] % len(b.inside)]]) for b in balls]
        drawn = torch.from_numpy(np.stack(rows))
        return drawn[..., :3], drawn[..., 3]

    return draw


def objective(decoder, codes, points, sdf):
    return clamped_l1(decoder(points, codes), sdf, 0.1) + 1e-4 * codes.square().mean()


@pytest.mark.parametrize("fit", FITS.values(), ids=FITS)
def test_a_fit_finds_codes_of_unseen_shapes_and_leaves_the_decoder_alone(decoder, fit):
    decoder.train()
    before = {name: value.clone() for name, value in decoder.state_dict().items()}
    fitted = fit(decoder, draws(0.47, 0.52), [0, 1])
    points, sdf = draws(0.47, 0.52)(1000)
    error = clamped_l1(decoder(points, fitted), sdf, 0.1)
    assert error < 0.3 * clamped_l1(decoder(points, torch.zeros(2, 4)), sdf, 0.1)
    assert error < 0.02
    assert all(torch.equal(before[name], value) for name, value in decoder.state_dict().items())
    assert all(parameter.requires_grad for parameter in decoder.parameters()) and decoder.training
    assert not fitted.requires_grad


@pytest.mark.parametrize(("fit", "tolerance"), [("adam", 1e-4), ("gauss_newton", 0)])
def test_shapes_fitted_together_get_the_codes_they_get_alone(decoder, fit, tolerance):
    radii, seeds = (0.45, 0.52, 0.48), (3, 4, 5)
    together = FITS[fit](decoder, draws(*radii), seeds)
    alone = [FITS[fit](decoder, draws(radius), [seed]) for radius, seed in zip(radii, seeds, strict=True)]
    assert torch.allclose(together, torch.cat(alone), rtol=0, atol=tolerance)


def test_a_shape_without_numbers_does_not_harm_its_neighbour(decoder):
    def broken(step):
        points, sdf = draws(0.45, 0.5)(step)
        sdf[0] = torch.nan
        return points, sdf

    start = initial_codes(decoder, NEWTON["spread"], [3])
    fitted = FITS["gauss_newton"](decoder, broken, [3, 4])
    assert torch.equal(fitted[:1], start)
    assert torch.allclose(fitted[1:], FITS["gauss_newton"](decoder, draws(0.5), [4]), atol=1e-5)


def test_shapes_fitted_in_one_batch_get_the_codes_they_get_alone(decoder):
    fit = FITS["gauss_newton"]
    start, (points, sdf) = initial_codes(decoder, 0.01, [3, 4, 5]), draws(0.45, 0.52, 0.48)(0)
    together = fit._fit(decoder, start, points, sdf)  # as on a GPU
    assert torch.allclose(together, fit(decoder, lambda step: (points, sdf), [3, 4, 5]), atol=1e-4)


def test_gauss_newton_reaches_adams_minimum(decoder):
    radii = (0.43, 0.47, 0.52, 0.54)
    fresh = draws(*radii, samples=2000)(1000)
    long = AdamFit(**ADAM | {"steps": 250})(decoder, draws(*radii), range(4))
    short = FITS["gauss_newton"](decoder, draws(*radii), range(4))
    with torch.no_grad():
        for shape in range(4):
            part = [tensor[shape : shape + 1] for tensor in fresh]
            values = [objective(decoder, codes[shape : shape + 1], *part) for codes in (short, long)]
            assert values[0] < 1.05 * values[1] + 1e-5


def test_the_jacobian_is_that_of_each_sample(decoder):
    points, codes = torch.rand(2, 5, 3) - 0.5, torch.randn(2, 4)
    field, jacobian = field_and_jacobian(decoder, points, codes)
    assert torch.allclose(field, decoder(points, codes), atol=1e-6)
    every = torch.autograd.functional.jacobian(lambda z: decoder(points, z), codes)  # [B, N, B, L]
    for shape in range(2):
        assert torch.allclose(jacobian[shape], every[shape, :, shape], atol=1e-5)


def test_the_quadratic_has_the_objectives_value_and_gradient(decoder):
    points, sdf = draws(0.45)(0)
    codes = torch.full((1, 4), 0.3, requires_grad=True)
    fit = GaussNewtonFit(**NEWTON | {"smallest": 1e-9})  # |r| everywhere, as in the objective
    value = objective(decoder, codes, points, sdf)
    (gradient,) = torch.autograd.grad(value, codes)
    about = fit._quadratic(decoder, points, sdf, codes.detach())
    assert torch.allclose(about.value, value, atol=1e-7)
    assert torch.allclose(about.gradient, gradient, atol=1e-5)


@pytest.mark.parametrize(
    ("fit", "settings", "message"),
    [
        (AdamFit, ADAM | {"steps": 0}, "at least 1"),
        (AdamFit, ADAM | {"lr": 0.0}, "positive"),
        (GaussNewtonFit, NEWTON | {"thinning": 0}, "at least 1"),
        (GaussNewtonFit, NEWTON | {"damping": 0.0}, "positive"),
    ],
)
def test_fit_settings_out_of_range_are_refused(fit, settings, message):
    with pytest.raises(ValueError, match=message):
        fit(**settings)
