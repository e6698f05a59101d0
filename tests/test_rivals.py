"""Rivals beyond the paper: what their own papers promise of them."""

import math

import pytest
import torch

from sdfhub.model.activations import Finer, Gauss, Siren, Wire
from sdfhub.model.decoder import Decoder
from sdfhub.model.encodings import Identity
from sdfhub.tasks.run import build_autodecoder
from tests.test_config import composed, parameters
from tests.test_model import ACTIVATIONS, small_decoder


def test_finers_frequency_grows_from_omega_to_2k_plus_1_times_omega():
    """Liu et al. 2024: sin(omega (|x| + 1) x) runs locally at omega (2 |x| + 1)."""
    omega, k = 40.0, 3.0
    crossing = torch.arange(1, 160) * torch.pi / omega  # where the phase passes a multiple of pi
    zeros = (torch.sqrt(1 + 4 * crossing) - 1) / 2
    finer = Finer(omega, omega, k)
    assert finer(torch.cat([zeros, -zeros])).abs().max() < 1e-3
    gaps, middles = zeros.diff(), (zeros[1:] + zeros[:-1]) / 2
    assert torch.allclose(torch.pi / gaps, omega * (2 * middles + 1), rtol=1e-3)
    slopes = finer.with_slope(torch.tensor([0.0, k]))[1].abs()
    assert slopes[0] == omega and slopes[1] <= (2 * k + 1) * omega


def spread_of_frequencies(activation) -> float:
    """Mean frequency of the features of a first layer along a line, weighted by power."""
    torch.manual_seed(0)
    decoder = Decoder(Identity(), lambda first: activation, 4, 1, 256)
    line = torch.zeros(1, 512, 3)
    line[0, :, 0] = torch.linspace(-1, 1, 512)
    product, shift = decoder.layers[0](line, torch.zeros(1, 4))
    features = activation(product + shift)[0].detach() * torch.hann_window(512)[:, None]
    power = torch.fft.rfft(features, dim=0).abs().square().sum(1)
    return float((power * torch.arange(len(power))).sum() / power.sum())


def test_finers_biases_choose_its_frequencies_and_sirens_do_not():
    """Liu et al. 2024: biases from U(-k, k) select sub-functions of higher frequency."""
    narrow, wide = (spread_of_frequencies(Finer(60.0, 60.0, k, first=True)) for k in (0.1, 4.0))
    assert wide > 2 * narrow
    assert spread_of_frequencies(Siren(60.0, 60.0, first=True)) < 1.5 * narrow


def test_finers_biases_start_as_its_authors_say():
    decoder = small_decoder(ACTIVATIONS["finer"], width=400, depth=3)
    first, *others = (layer.linear.bias.detach().abs() for layer in decoder.layers[:-1])
    assert 0.95 * 0.5 < first.max() <= 0.5
    assert abs(first.mean() - 0.25) < 0.03
    assert all(bias.max() <= 1 / 400**0.5 for bias in others)


def test_a_narrow_gaussian_has_features_of_high_rank_and_steep_slopes():
    """Ramasinghe and Lucey 2022: stable rank and Lipschitz constant both grow as 1 / a."""

    def stable_rank(a: float) -> float:
        points = torch.linspace(-1, 1, 256)[:, None]
        features = Gauss(a)(points - torch.linspace(-1, 1, 128))
        singular = torch.linalg.svdvals(features - features.mean(0))
        return float(singular.square().sum() / singular[0].square())

    ranks = [stable_rank(a) for a in (1.0, 0.3, 0.1, 0.03)]
    assert ranks == sorted(ranks) and ranks[-1] > 10 * ranks[0]
    x = torch.linspace(-2, 2, 4001)
    for a in (1.0, 0.3):
        slope = Gauss(a).with_slope(x)[1].abs()
        assert float(slope.max()) == pytest.approx(math.exp(-0.5) / a, rel=1e-4)
        assert float(x[slope.argmax()].abs()) == pytest.approx(a, abs=2e-3)


def test_wire_is_compact_in_space_and_in_frequency():
    """Saragadam et al. 2023: the spectrum of a Gabor wavelet is a Gaussian about its frequency."""
    omega, s, step = 12.0, 2.0, 0.01
    x = torch.arange(-1000, 1000, dtype=torch.double) * step
    wave = Wire(omega, omega, s)(x)
    assert torch.allclose(wave, torch.exp(1j * omega * x - (s * x).abs().square()).real)
    assert wave[x.abs() > 4 / s].abs().max() < 2e-7
    spectrum = torch.fft.rfft(wave).abs() * step
    k = torch.fft.rfftfreq(len(x), step).double() * 2 * torch.pi
    bumps = torch.exp(-((k - omega) / (2 * s)).square()) + torch.exp(-((k + omega) / (2 * s)).square())
    assert torch.allclose(spectrum, math.sqrt(math.pi) / (2 * s) * bumps, atol=1e-6)


@pytest.mark.parametrize(
    ("choice", "settings"),
    [
        (Finer, {"omega_0": 0.0, "omega_hidden": 1.0, "k": 1.0}),
        (Finer, {"omega_0": 1.0, "omega_hidden": 1.0, "k": -1.0}),
        (Gauss, {"a": 0.0}),
        (Wire, {"omega_0": 1.0, "omega_hidden": 1.0, "s": 0.0}),
    ],
)
def test_widths_and_frequencies_must_be_positive(choice, settings):
    with pytest.raises(ValueError, match="positive"):
        choice(**settings, first=True)


@pytest.mark.parametrize("choice", ["finer", "gauss", "wire"])
def test_mixed_precision_changes_little(choice):
    decoder = small_decoder(ACTIVATIONS[choice], width=64)
    points, codes = torch.rand(2, 50, 3) - 0.5, torch.randn(2, 4)
    exact, slope = decoder.value_and_gradient(points, codes)
    with torch.autocast("cpu", torch.bfloat16):
        value, gradient = decoder.value_and_gradient(points, codes)
    assert value.dtype == gradient.dtype == torch.float32
    assert (value - exact).abs().max() < 0.02 * exact.abs().max()
    assert (gradient - slope).abs().max() < 0.05 * slope.abs().max()


@pytest.mark.parametrize("choice", ["finer", "gauss", "wire"])
def test_no_rival_costs_parameters(choice):
    decoder = build_autodecoder(composed(f"activation={choice}", "scale=paper"), rows=1).decoder
    assert parameters(decoder) == 585_073
