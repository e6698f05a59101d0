"""Rivals side by side: every choice of conf/ has right derivatives, and is what its own paper promises."""

import math
from functools import partial

import pytest
import torch
from torch import nn

from sdfhub.errors import SdfhubError
from sdfhub.model.activations import Activation, Finer, Gauss, Siren, Wire
from sdfhub.model.conditioning import Concat, Film, Layer
from sdfhub.model.decoder import Decoder
from sdfhub.model.encodings import Fourier, Identity
from sdfhub.model.losses import Loss
from sdfhub.model.optimisers import Cosine, Optimisation
from sdfhub.testing import check_derivatives
from tests.rivals import choices, rival
from tests.test_model import ACTIVATIONS, parameters, small_decoder

GROUPS = ("activation", "encoding", "conditioning")


@pytest.mark.parametrize(
    ("group", "choice"), [(group, choice) for group in GROUPS for choice in choices(group)]
)
def test_what_conf_names_has_right_derivatives(group, choice):
    check_derivatives(rival(group, choice))


@pytest.mark.parametrize("choice", choices("activation"))
def test_stated_slopes_are_autograds(choice):
    activation = rival("activation", choice)()
    x = torch.randn(2, 5, 4)
    for stated, default in zip(activation.with_slope(x), Activation.with_slope(activation, x), strict=True):
        torch.testing.assert_close(stated, default, rtol=1e-4, atol=1e-5)


class Snake(Activation):
    def __init__(self, a: float):
        super().__init__()
        self.a = nn.Parameter(torch.tensor(float(a)))

    def forward(self, x):
        return x + torch.sin(self.a * x).square() / self.a


class Radial(nn.Module):
    """No `Encoding`: a module with `features`."""

    features = 4

    def forward(self, points):
        return torch.cat([points, points.square().sum(-1, keepdim=True)], dim=-1)


class Gated(Layer):
    """Conditioning by a gate, with `forward` alone."""

    def __init__(self, hidden, encoding, code, outputs):
        super().__init__(hidden, encoding, code, outputs)
        self.gate = nn.Linear(code, outputs) if code else None

    def forward(self, inputs, codes):
        product, shift = nn.functional.linear(inputs, self.linear.weight), self.linear.bias
        if self.gate is None:
            return product, shift
        gate = torch.sigmoid(self.gate(codes))[:, None]
        return product * gate, shift * gate


@pytest.mark.parametrize(
    "make", [partial(Snake, a=2), nn.GELU, nn.PReLU, nn.Softplus(beta=5.0), Radial, Gated], ids=repr
)
def test_a_rival_needs_forward_alone(make):
    check_derivatives(make)


def test_a_users_rivals_train_without_gradients_and_in_half_precision():
    decoder = small_decoder(partial(Snake, a=2), Radial(), conditioning=Gated, inject_code=[1])
    points, codes = torch.rand(2, 5, 3) - 0.5, torch.randn(2, 4)
    want = decoder.value_and_gradient(points, codes)
    for mode in (torch.no_grad(), torch.inference_mode(), torch.autocast("cpu", torch.bfloat16)):
        with mode:
            for have, exact in zip(decoder.value_and_gradient(points, codes), want, strict=True):
                torch.testing.assert_close(have, exact, rtol=0.1, atol=0.02)
    fast = torch.compile(decoder.value_and_gradient, backend="aot_eager")(points, codes)
    gradients = [
        torch.autograd.grad(sdf.sum() + slope.square().sum(), list(decoder.parameters()))
        for sdf, slope in (fast, want)
    ]
    for one, other in zip(*gradients, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-4)


class WrongSlope(Gauss):
    def with_slope(self, x):
        value, slope = super().with_slope(x)
        return value, 1.01 * slope


class ConstantSlope(Gauss):
    def with_slope(self, x):
        value, slope = super().with_slope(x)
        return value, slope.detach()


class Normalised(Activation):
    def forward(self, x):
        return torch.softmax(x, dim=-1)


class Root(Activation):
    def forward(self, x):
        return x.abs().sqrt()


class OtherFeatures(Fourier):
    def with_pullback(self, points):
        features, pullback = super().with_pullback(points)
        return features, lambda cotangent: 2 * pullback(cotangent)


class Unread(Film):
    def pullback(self, cotangent, codes):
        return Concat.pullback(self, cotangent, codes)


class Bent(Gated):
    def forward(self, inputs, codes):
        product, shift = super().forward(inputs, codes)
        return product.tanh(), shift


@pytest.mark.parametrize(
    ("make", "complaint"),
    [
        (partial(WrongSlope, 0.5), "WrongSlope: with_slope gives a wrong derivative"),
        (partial(ConstantSlope, 0.5), "ConstantSlope: with_slope has a wrong derivative"),
        (Normalised, "Normalised: is not elementwise"),
        (Root, "Root: value or slope at 0 is not finite"),
        (partial(OtherFeatures, 2), "OtherFeatures: with_pullback gives a wrong derivative"),
        (Unread, "Unread: pullback gives a wrong derivative"),
        (Bent, "Bent: the product is not linear in its inputs"),
    ],
)
def test_a_wrong_rival_is_refused_in_a_line(make, complaint):
    with pytest.raises(AssertionError, match=complaint):
        check_derivatives(make)


def test_what_is_no_rival_is_refused():
    with pytest.raises(ValueError, match="activation must make a torch"):
        small_decoder(lambda: torch.sin)
    with pytest.raises(ValueError, match="encoding must be a torch"):
        small_decoder(encoding=nn.Linear(3, 4))


def rates(optimizer) -> dict[str, float]:
    return {group["name"]: group["lr"] for group in optimizer.param_groups}


@pytest.mark.parametrize(
    ("make", "kind"),
    [
        (Optimisation(1e-3, 1e-2, Cosine()), torch.optim.Adam),
        (
            partial(Optimisation, 1e-3, 1e-2, optimizer=partial(torch.optim.SGD, momentum=0.9)),
            torch.optim.SGD,
        ),
        (
            partial(torch.optim.AdamW, lr_decoder=1e-3, lr_codes=1e-2, warmup_steps=5, weight_decay=0.1),
            torch.optim.AdamW,
        ),
        (partial(torch.optim.RMSprop, lr=1e-2, lr_decoder=1e-3, optimizer=None), torch.optim.RMSprop),
    ],
)
def test_any_optimiser_of_torch_steps_both_groups(make, kind):
    decoder, codes = nn.Parameter(torch.ones(2, 2)), nn.Parameter(torch.ones(2))
    optimisation = Optimisation.of(make)
    optimizer, schedule = optimisation.configure([decoder], [codes], steps=10)
    factor = optimisation.factor(0, 10)
    assert type(optimizer) is kind
    assert rates(optimizer) == pytest.approx({"decoder": 1e-3 * factor, "codes": 1e-2 * factor})
    (decoder.sum() + codes.sum()).backward()
    optimizer.step()
    schedule.step()
    assert (decoder < 1).all() and (codes < 1).all()
    assert optimizer.defaults.get("weight_decay", 0) == (0.1 if kind is torch.optim.AdamW else 0)


def test_an_optimisation_refuses_rates_out_of_range():
    for settings in ({"lr_decoder": 0.0}, {"lr_codes": -1}, {"warmup_steps": -1}, {"lr_decoder": "fast"}):
        with pytest.raises(ValueError, match=next(iter(settings))):
            Optimisation(**{"lr_decoder": 1e-3, "lr_codes": 1e-2} | settings)


class Squared(Loss):
    def __call__(self, predicted, target, codes, gradients, normals, progress):
        return (predicted - target).square().mean()


def test_a_loss_needs_a_call_alone():
    loss = Squared()
    arguments = torch.ones(1, 4), torch.zeros(1, 4), torch.ones(1, 4), None, None, 0.5
    assert (
        loss.parts(*arguments) == {"objective": 1.0} and not loss.wants_gradients(0.5) and loss.delta == 0.1
    )
    sdf = rival("loss", "paper")
    assert sdf(*arguments) == sum(sdf.parts(*arguments).values())


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
        assert slope.max().item() == pytest.approx(math.exp(-0.5) / a, rel=1e-4)
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
    with pytest.raises(SdfhubError, match="greater than 0"):
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


@pytest.mark.parametrize("choice", [choice for choice in choices("activation") if choice != "hosc"])
def test_no_rival_costs_parameters(choice):
    decoder = Decoder(Fourier(12), rival("activation", choice), 256, 5, 384, [1, 2, 3, 4, 5])
    assert parameters(decoder) == 585_073


def test_film_decoders_start_inside_the_clamp():
    decoder = small_decoder(conditioning=Film, width=128, depth=5, inject_code=[1, 2])
    assert decoder(torch.rand(4, 500, 3) * 2 - 1, torch.randn(4, 4)).abs().quantile(0.99) < 0.1
