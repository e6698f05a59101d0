"""Activations, encodings, decoder and codes: what their papers promise."""

from functools import partial

import pytest
import torch

from sdfhub.errors import SdfhubError
from sdfhub.model.activations import Finer, Gauss, Hosc, Relu, Siren, Wire
from sdfhub.model.codes import CodeTable
from sdfhub.model.decoder import Decoder
from sdfhub.model.encodings import Fourier, Gaussian, Hash, Identity

ACTIVATIONS = {
    "relu": Relu,
    "siren": partial(Siren, omega_0=3.0, omega_hidden=2.0),
    "hosc": partial(Hosc, omega_0=3.0, omega_hidden=2.0, beta=2.0),
    "finer": partial(Finer, omega_0=3.0, omega_hidden=2.0, k=0.5),
    "gauss": partial(Gauss, a=0.5),
    "wire": partial(Wire, omega_0=3.0, omega_hidden=2.0, s=1.0),
}
ENCODINGS = {
    "none": Identity,
    "fourier": partial(Fourier, frequencies=2),
    "gaussian": partial(Gaussian, rows=4, sigma=0.5),
    "hash": partial(Hash, levels=2, width=2, log2_table=6, coarsest=2, finest=7),
}


def parameters(module: torch.nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def small_decoder(activation=ACTIVATIONS["hosc"], encoding=None, **settings) -> Decoder:
    torch.manual_seed(0)
    settings = {"code_size": 4, "depth": 2, "width": 16, "shorten": False} | settings
    return Decoder(encoding or Identity(), activation, **settings)


def test_hosc_is_tanh_of_beta_sine_and_beta_is_learned_and_positive():
    hosc = Hosc(omega_0=3.0, omega_hidden=2.0, beta=4.0)
    x = torch.linspace(-2, 2, 101)
    assert torch.allclose(hosc(x), torch.tanh(4.0 * torch.sin(2.0 * x)), atol=1e-6)
    torch.optim.SGD(hosc.parameters(), lr=1e3).zero_grad()
    hosc(x).square().sum().backward()
    assert hosc.log_beta.grad.abs() > 0
    with torch.no_grad():
        hosc.log_beta -= 50
    assert hosc.beta > 0


def test_hosc_nears_a_scaled_sine_for_small_beta_and_a_square_wave_for_large():
    x = torch.linspace(-3, 3, 601)
    small, large = Hosc(1.0, 1.0, beta=1e-3), Hosc(1.0, 1.0, beta=1e4)
    assert torch.allclose(small(x) / 1e-3, torch.sin(x), atol=1e-5)
    away_from_zero = torch.sin(x).abs() > 1e-2
    assert torch.allclose(large(x)[away_from_zero], torch.sin(x).sign()[away_from_zero])


def test_first_layer_has_its_own_frequency():
    x = torch.linspace(-1, 1, 11)
    assert torch.allclose(Siren(30.0, 3.0, first=True)(x), torch.sin(30 * x))
    assert torch.allclose(Siren(30.0, 3.0)(x), torch.sin(3 * x))


@pytest.mark.parametrize("settings", [{"omega_0": 0.0}, {"omega_hidden": -1.0}, {"beta": 0.0}])
def test_frequencies_and_sharpness_must_be_positive(settings):
    with pytest.raises(SdfhubError, match="Hosc.*greater than 0"):
        for first in (True, False):
            Hosc(**{"omega_0": 1.0, "omega_hidden": 1.0, "beta": 1.0} | settings, first=first)


def test_siren_initialisation_keeps_unit_scale_through_depth():
    """Sitzmann et al. 2020, theorem 1.8: a Gaussian of variance s leaves sine and the next layer with
    variance 2 E[sin^2] = 1 - exp(-2 s), whose fixed point is s = 0.797."""
    torch.manual_seed(0)
    hidden = torch.randn(2000, 256).clamp(-1, 1)
    for _ in range(6):
        siren = Siren(30.0, 5.0)
        linear = torch.nn.Linear(256, 256, bias=False)
        linear.weight.data.uniform_(-siren.weight_bound(256), siren.weight_bound(256))
        before = 5.0 * linear(hidden)
        hidden = siren(linear(hidden))
    assert abs(before.var() - 0.797) < 0.05
    assert abs(hidden.var() - 0.797 / 2) < 0.03


@pytest.mark.parametrize("weight_norm", [False, True])
def test_weight_norm_respects_the_initialisation(weight_norm):
    decoder = small_decoder(ACTIVATIONS["siren"], weight_norm=weight_norm, width=64)
    hidden = decoder.layers[1].linear.weight
    bound = (6 / 64) ** 0.5 / 2.0
    assert hidden.abs().max() <= bound
    assert hidden.abs().max() > 0.95 * bound


def test_fourier_features_are_octaves_of_sine_and_cosine():
    x = torch.rand(5, 3) * 2 - 1
    features = Fourier(3)(x)
    for k in range(3):
        assert torch.allclose(features[:, k], torch.sin(2**k * torch.pi * x[:, 0]), atol=1e-5)
        assert torch.allclose(features[:, 9 + k], torch.cos(2**k * torch.pi * x[:, 0]), atol=1e-5)
    assert Fourier(12).features == 72
    assert torch.equal(Fourier(3, include_points=True)(x)[:, :3], x)


def test_gaussian_features_see_only_differences():
    """Tancik et al. 2020: the inner product of two encodings depends on x - y alone."""
    torch.manual_seed(0)
    encoding = Gaussian(rows=64, sigma=1.0)
    x, y, shift = torch.rand(3, 7, 3)
    inner = (encoding(x) * encoding(y)).sum(-1)
    moved = (encoding(x + shift) * encoding(y + shift)).sum(-1)
    assert torch.allclose(inner, moved, atol=1e-3)


def test_gaussian_directions_are_saved():
    assert "directions" in Gaussian(rows=4, sigma=1.0).state_dict()


def test_hash_interpolates_its_corners_and_has_a_continuous_slope():
    encoding = Hash(levels=1, width=1, log2_table=10, coarsest=4, finest=4, include_points=False)
    with torch.no_grad():
        encoding.table.copy_(torch.rand_like(encoding.table))
    corner = torch.tensor([[0.5, -0.5, 0.0]])  # vertex (3, 1, 2) of 4 cells over [-1, 1]
    assert torch.allclose(encoding(corner), encoding.table[(3 * 5 + 1) * 5 + 2], atol=1e-6)
    step = torch.tensor([[1e-3, 0.0, 0.0]])
    left = (encoding(corner) - encoding(corner - step)) / 1e-3
    right = (encoding(corner + step) - encoding(corner)) / 1e-3
    assert (left - right).abs() < 0.02


def test_hash_tables_never_exceed_their_size_and_every_point_finds_a_row():
    encoding = Hash(levels=6, width=2, log2_table=8, coarsest=2, finest=200)
    assert max(encoding.rows) == 256
    assert len(encoding.table) == sum(encoding.rows)
    points = torch.rand(1000, 3) * 2.6 - 1.3  # jitter may leave the cube
    assert torch.isfinite(encoding(points)).all()


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_first_and_second_derivatives_are_right(activation, encoding):
    """The normal loss differentiates the spatial gradient by the weights."""
    decoder = small_decoder(ACTIVATIONS[activation], ENCODINGS[encoding](), width=8).double()
    with torch.no_grad():
        for parameter in decoder.parameters():  # a zero-initialised table would hide a wrong derivative
            parameter += 0.05 * torch.randn_like(parameter)
    torch.manual_seed(1)
    points = (torch.rand(1, 3, 3, dtype=torch.double) * 1.6 - 0.8).requires_grad_()
    codes = torch.randn(1, 4, dtype=torch.double, requires_grad=True)
    assert torch.autograd.gradcheck(decoder, (points, codes))
    assert torch.autograd.gradgradcheck(decoder, (points, codes))


@pytest.mark.parametrize("settings", [{}, {"tanh": True}, {"inject_encoding": [1, 2], "inject_code": [1]}])
@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_written_out_gradient_equals_autograds_and_so_do_its_derivatives(activation, encoding, settings):
    """The fast path against its plain twin, a double backward, in double precision."""
    decoder = small_decoder(ACTIVATIONS[activation], ENCODINGS[encoding](), **settings).double()
    with torch.no_grad():
        for parameter in decoder.parameters():
            parameter += 0.05 * torch.randn_like(parameter)
    points = torch.rand(2, 7, 3, dtype=torch.double) * 1.6 - 0.8
    codes = torch.randn(2, 4, dtype=torch.double, requires_grad=True)
    learned = [*decoder.parameters(), codes]

    def objective(values, gradients):
        return (values.square().sum() + (gradients - 0.3).pow(4).sum(),)

    values, gradients = decoder.value_and_gradient(points, codes)
    derivatives = torch.autograd.grad(objective(values, gradients), learned, allow_unused=True)

    leaf = points.clone().requires_grad_()
    plain = decoder(leaf, codes)
    (plain_gradients,) = torch.autograd.grad(plain.sum(), leaf, create_graph=True)
    plain_derivatives = torch.autograd.grad(objective(plain, plain_gradients), learned, allow_unused=True)

    assert torch.allclose(values, plain, atol=1e-12)
    assert torch.allclose(gradients, plain_gradients, atol=1e-10)
    for ours, theirs in zip(derivatives, plain_derivatives, strict=True):
        assert (ours is None) == (theirs is None)
        assert ours is None or torch.allclose(ours, theirs, atol=1e-9, rtol=1e-9)


def test_written_out_gradient_meets_the_same_dropped_units_as_its_values():
    decoder = small_decoder(dropout=0.5).double()
    torch.manual_seed(3)
    points = (torch.rand(1, 1, 3, dtype=torch.double) - 0.5).requires_grad_()
    codes = torch.randn(1, 4, dtype=torch.double)
    torch.manual_seed(5)
    values, gradients = decoder.value_and_gradient(points, codes)
    for axis in range(3):
        moved = points.detach().clone()
        moved[..., axis] += 1e-6
        torch.manual_seed(5)
        slope = (decoder.value_and_gradient(moved, codes)[0] - values) / 1e-6
        assert torch.allclose(slope, gradients[..., axis], atol=1e-4)


def test_deepsdf_has_its_published_number_of_parameters():
    decoder = Decoder(Identity(), Relu, 256, 8, 512, [4], [4], dropout=0.2, tanh=True)
    assert parameters(decoder) == 1_843_195


@pytest.mark.parametrize("activation", ["siren", "hosc"])
def test_paper_decoder_has_a_third_of_the_parameters(activation):
    decoder = Decoder(Fourier(12), ACTIVATIONS[activation], 256, 5, 384, [1, 2, 3, 4, 5])
    assert abs(parameters(decoder) / 585_073 - 1) < 1e-3


@pytest.mark.parametrize("inject", [((), ()), ((1,), (2,)), ((1, 2), (1, 2))])
def test_broadcast_code_equals_a_code_copied_once_per_point(inject):
    """The fast path against its plain twin: one linear layer over [hidden | encoding | code] per point."""
    decoder = small_decoder(inject_encoding=inject[0], inject_code=inject[1])
    points, codes = torch.rand(3, 5, 3), torch.randn(3, 4)
    copied = codes[:, None].expand(3, 5, 4)
    hidden = torch.empty(3, 5, 0)
    for index, layer in enumerate(decoder.layers):
        parts = [hidden]
        parts += [points] if index == 0 or index in inject[0] else []
        parts += [copied] if index == 0 or index in inject[1] else []
        hidden = layer.linear(torch.cat(parts, dim=-1))
        if index < len(decoder.activations):
            hidden = decoder.activations[index](hidden)
    assert torch.allclose(decoder(points, codes), hidden.squeeze(-1), atol=1e-6)


@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("encoding", ENCODINGS)
def test_initial_outputs_stay_inside_the_clamp(activation, encoding):
    """A prediction outside [-delta, delta] gets no gradient from the clamped L1."""
    decoder = small_decoder(ACTIVATIONS[activation], ENCODINGS[encoding](), width=128, depth=5)
    assert decoder(torch.rand(4, 500, 3) * 2 - 1, torch.randn(4, 4)).abs().quantile(0.99) < 0.1


def test_tanh_bounds_the_output_and_dropout_acts_only_in_training():
    decoder = small_decoder(tanh=True, dropout=0.5)
    points, codes = torch.rand(1, 50, 3), torch.randn(1, 4)
    assert decoder(points, codes).abs().max() < 1
    assert not torch.equal(decoder(points, codes), decoder(points, codes))
    decoder.eval()
    assert torch.equal(decoder(points, codes), decoder(points, codes))


def test_decoder_that_cannot_be_built_says_why():
    with pytest.raises(ValueError, match="leaves no room"):
        Decoder(Fourier(12), Relu, 256, 5, 64, [1, 2, 3, 4, 5])
    with pytest.raises(ValueError, match="layers 1 to 2"):
        small_decoder(inject_code=[3])


def test_codes_start_with_expected_norm_one():
    torch.manual_seed(0)
    norms = CodeTable(500, 64).table.norm(dim=1)
    assert abs(norms.mean() - 1) < 0.05


def test_max_norm_shortens_long_codes_and_leaves_short_ones():
    torch.manual_seed(0)
    codes = CodeTable(20, 8, max_norm=0.9)
    before = codes.table.detach().clone()
    read = codes(torch.arange(10))
    norms = before.norm(dim=1, keepdim=True)
    assert norms.min() < 0.9 < norms.max()
    assert torch.allclose(codes.table, before * (0.9 / norms).clamp(max=1), atol=1e-5)
    assert torch.equal(read, codes.table[:10])
