"""How a code enters the decoder: as input columns, or as scale and shift of what a layer makes of a point."""

import pytest
import torch

from sdfhub.model.conditioning import Concat, Film
from tests.test_model import ACTIVATIONS, parameters, small_decoder
from tests.tiny import build_autodecoder, composed

SETTINGS = [{}, {"tanh": True, "weight_norm": False}, {"inject_encoding": [1, 2], "inject_code": [1, 2]}]


def film_decoder(activation="hosc", **settings):
    return small_decoder(ACTIVATIONS[activation], conditioning=Film, **settings)


@pytest.mark.parametrize("settings", SETTINGS)
def test_film_equals_scale_and_shift_copied_once_per_point(settings):
    """The fast path against its plain twin, which applies one map per point."""
    decoder = film_decoder(**settings)
    points, codes = torch.rand(3, 5, 3) - 0.5, torch.randn(3, 4)
    copied = codes[:, None].expand(3, 5, 4)
    inject_encoding, inject_code = (settings.get(f"inject_{part}", []) for part in ("encoding", "code"))
    hidden = torch.empty(3, 5, 0)
    for index, layer in enumerate(decoder.layers):
        parts = [hidden, points] if index == 0 or index in inject_encoding else [hidden]
        hidden = layer.linear(torch.cat(parts, dim=-1))
        assert (layer.film is not None) == (index == 0 or index in inject_code)
        if layer.film is not None:
            scale, shift = layer.film(copied).chunk(2, dim=-1)
            hidden = (1 + scale) * hidden + shift
        if index < len(decoder.activations):
            hidden = decoder.activations[index](hidden)
    plain = hidden.squeeze(-1).tanh() if settings.get("tanh") else hidden.squeeze(-1)
    assert torch.allclose(decoder(points, codes), plain, atol=1e-6)


@pytest.mark.parametrize("settings", SETTINGS)
@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_films_gradient_equals_autograds_and_so_do_its_derivatives(activation, settings):
    decoder = film_decoder(activation, **settings).double()
    points = (torch.rand(2, 7, 3, dtype=torch.double) * 1.6 - 0.8).requires_grad_()
    codes = torch.randn(2, 4, dtype=torch.double, requires_grad=True)
    learned = [*decoder.parameters(), codes]
    values, gradients = decoder.value_and_gradient(points.detach(), codes)
    plain = decoder(points, codes)
    (plain_gradients,) = torch.autograd.grad(plain.sum(), points, create_graph=True)
    assert torch.allclose(values, plain, atol=1e-12)
    assert torch.allclose(gradients, plain_gradients, atol=1e-10)
    both = [
        torch.autograd.grad(value.square().sum() + (slope - 0.3).pow(4).sum(), learned, allow_unused=True)
        for value, slope in ((values, gradients), (plain, plain_gradients))
    ]
    for ours, theirs in zip(*both, strict=True):
        assert (ours is None) == (theirs is None)
        assert ours is None or torch.allclose(ours, theirs, atol=1e-9, rtol=1e-9)


def test_film_under_mixed_precision_changes_little():
    decoder = film_decoder(width=64, inject_code=[1])
    points, codes = torch.rand(2, 50, 3) - 0.5, torch.randn(2, 4)
    exact, slope = decoder.value_and_gradient(points, codes)
    with torch.autocast("cpu", torch.bfloat16):
        value, gradient = decoder.value_and_gradient(points, codes)
    assert (value - exact).abs().max() < 0.02 * exact.abs().max()
    assert (gradient - slope).abs().max() < 0.05 * slope.abs().max()


def test_film_decoders_start_inside_the_clamp_and_depend_on_their_codes():
    config = composed("conditioning=film")
    decoder = build_autodecoder(config, rows=1).decoder
    points, codes = torch.rand(4, 500, 3) * 2 - 1, torch.randn(4, 64) / 8
    assert decoder(points, codes).abs().quantile(0.99) < 0.1
    codes.requires_grad_()
    (slope,) = torch.autograd.grad(decoder(points, codes).square().sum(), codes)
    assert slope.abs().amax(dim=1).min() > 0


def test_film_has_a_scale_and_a_shift_for_every_unit_of_the_layers_that_read_the_code():
    concat, film = (
        build_autodecoder(composed(f"conditioning={choice}"), rows=1).decoder for choice in ("concat", "film")
    )
    size, width, layers = 64, 128, 5
    assert parameters(film) - parameters(concat) == layers * ((size + 1) * 2 * width - size * width)


def test_a_layer_before_a_film_layer_makes_room_for_the_encoding_alone():
    """Where layers shorten, those after them read `width` columns; a code that steers is none of them."""
    settings = {"inject_encoding": [1], "inject_code": [1], "shorten": True, "width": 32, "depth": 2}
    film, concat = (small_decoder(conditioning=kind, **settings) for kind in (Film, Concat))
    assert [layer.linear.out_features for layer in film.layers] == [29, 32, 1]
    assert [layer.linear.out_features for layer in concat.layers] == [25, 32, 1]
    assert film.layers[1].linear.in_features == concat.layers[1].linear.in_features == 32
