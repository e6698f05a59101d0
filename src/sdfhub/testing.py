"""Checks for rivals of one's own: `check_derivatives(MyActivation, a=2.0)` raises where one is wrong."""

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from sdfhub.model.activations import Activation, new_activation
from sdfhub.model.conditioning import Concat, Layer
from sdfhub.model.decoder import Decoder
from sdfhub.model.encodings import Encoding, Identity, as_encoding

STEP, TOLERANCE = 1e-6, 1e-4
"""Of central differences in float64, and how far they may be off, of the largest derivative."""


def check_derivatives(make: Any, **settings: Any) -> None:
    """Checks an activation, an encoding or a conditioning against differences in float64.

    Values, first derivatives, the derivatives of those by points, codes and weights (which a loss of normals
    needs), shapes, dtypes and finite numbers, alone and within a small decoder.

    Args:
        make: a class, a partial of one, or an instance: an `Activation` or elementwise module, an `Encoding`
            or module with `features`, or a class of `Layer`.
        settings: arguments of the class.

    Raises:
        AssertionError: says what is wrong.
    """
    make = partial(make, **settings) if settings else make
    torch.manual_seed(0)
    if _is_layer(make):
        for hidden, code in ((6, 4), (0, 4), (6, 0)):
            _check_layer(make(hidden, 3, code, 5).double())
        _check_decoder(Identity(), make, nn.Tanh)
        return
    made = make if isinstance(make, nn.Module) else None
    if made is None and not _is_activation(make):
        made = make()
    if made is not None and hasattr(made, "features"):
        encoding = as_encoding(made).double()
        _check_encoding(encoding)
        _check_decoder(encoding, Concat, nn.Tanh)
        return
    for first in (True, False):
        _check_activation(new_activation(make, first).double())
    _check_decoder(Identity(), Concat, make)


def _is_layer(make: Any) -> bool:
    kind = getattr(make, "func", make)
    return isinstance(kind, type) and issubclass(kind, Layer)


def _is_activation(make: Any) -> bool:
    kind = getattr(make, "func", make)
    return isinstance(kind, type) and issubclass(kind, Activation)


def _check_activation(activation: Activation) -> None:
    name = type(getattr(activation, "function", activation)).__name__
    x = torch.randn(2, 5, 4, dtype=torch.double)
    value = activation(x)
    assert value.shape == x.shape, f"{name}: forward gives {list(value.shape)} of {list(x.shape)}"
    alone = activation(x[..., :1].contiguous())
    _same(f"{name}: is not elementwise", alone, value[..., :1])
    _check_dtype(name, activation, lambda x: activation.with_slope(x), x)
    at_zero = activation.with_slope(torch.zeros_like(x))
    assert all(part.isfinite().all() for part in at_zero), f"{name}: value or slope at 0 is not finite"
    x.requires_grad_()
    have, slope = activation.with_slope(x)
    _same(f"{name}: with_slope gives another value than forward", have, value)
    _same(f"{name}: with_slope gives a wrong slope", slope, _difference(activation, x))
    _same(
        f"{name}: the slope has a wrong derivative",
        _gradient(slope, x),
        _difference(lambda x: activation.with_slope(x)[1], x),
    )
    _check_weights(name, activation, lambda: sum(part.square().sum() for part in activation.with_slope(x)))
    _check_modes(name, lambda: activation.with_slope(x))
    bounds = activation.weight_bound(64), activation.bias_bound()
    assert all(bound is None or 0 < bound < float("inf") for bound in bounds), (
        f"{name}: weight_bound and bias_bound must be positive, got {bounds[0]} and {bounds[1]}"
    )


def _check_encoding(encoding: Encoding) -> None:
    name = type(getattr(encoding, "module", encoding)).__name__
    _shake(encoding)
    points = torch.rand(2, 5, 3, dtype=torch.double) * 1.6 - 0.8
    value = encoding(points)
    shape = [2, 5, encoding.features]
    assert list(value.shape) == shape, f"{name}: features {list(value.shape)}, expected {shape}"
    for place in (torch.zeros_like(points), points * 1.6):
        assert encoding(place).isfinite().all(), f"{name}: features at 0 or outside the cube are not finite"
    cotangent = torch.randn_like(value)

    def pulled(points: Tensor) -> tuple[Tensor, Tensor]:
        features, pullback = encoding.with_pullback(points)
        return features, pullback(cotangent.to(points.dtype))

    _check_dtype(name, encoding, pulled, points)
    features, by_points = pulled(points)
    _same(f"{name}: with_pullback gives other features than forward", features, value)
    _same(f"{name}: the pullback is wrong", by_points, _transposed(encoding, points, cotangent))
    _check_weights(name, encoding, lambda: pulled(points)[1].square().sum())
    _check_modes(name, lambda: pulled(points))


def _check_layer(layer: Layer) -> None:
    name = type(layer).__name__
    hidden, encoding, _ = layer.columns
    _shake(layer)
    inputs = torch.randn(2, 5, hidden + encoding, dtype=torch.double)
    codes = torch.randn(2, 4, dtype=torch.double)
    product, shift = layer(inputs, codes)
    assert list(product.shape) == [2, 5, 5], f"{name}: product {list(product.shape)}, expected [2, 5, 5]"
    assert shift.shape in ((5,), (2, 1, 5)), f"{name}: shift {list(shift.shape)}, expected [5] or [2, 1, 5]"
    twice = layer(2 * inputs, codes)
    _same(f"{name}: the product is not linear in its inputs", twice[0], 2 * product)
    _same(f"{name}: the shift depends on the inputs", twice[1], shift)
    cotangent = torch.randn_like(product)
    parts = layer.pullback(cotangent, codes)
    for part, size in zip(parts, (hidden, encoding), strict=True):
        assert (part is None) == (size == 0), f"{name}: pullback must give None for what is not read, alone"
    wanted = _transposed(lambda inputs: layer(inputs, codes)[0], inputs, cotangent)
    have = torch.cat([part for part in parts if part is not None], dim=-1)
    _same(f"{name}: the pullback is wrong", have, wanted)
    _check_weights(
        name,
        layer,
        lambda: sum(part.square().sum() for part in layer.pullback(cotangent, codes) if part is not None),
    )


def _check_decoder(encoding: nn.Module, conditioning: Callable[..., Layer], activation: Any) -> None:
    decoder = Decoder(
        encoding, activation, code_size=4, depth=2, width=8, inject_encoding=[1], inject_code=[1],
        shorten=False, weight_norm=False, conditioning=conditioning,
    ).double()  # fmt: skip
    _shake(decoder)
    points = (torch.rand(2, 5, 3, dtype=torch.double) * 1.6 - 0.8).requires_grad_()
    codes = torch.randn(2, 4, dtype=torch.double, requires_grad=True)
    learned = [codes, *(weight for weight in decoder.parameters() if weight.requires_grad)]
    plain = decoder(points, codes)
    gradient = torch.autograd.grad(plain.sum(), points, create_graph=True)[0]
    have = decoder.value_and_gradient(points.detach(), codes)
    _same("in a decoder: another value than forward's", have[0], plain)
    _same("in a decoder: the gradient in space is wrong", have[1], gradient)
    by_learned = [
        torch.autograd.grad(
            value.square().sum() + (slope - 0.3).pow(4).sum(),
            learned,
            materialize_grads=True,
            allow_unused=True,
        )
        for value, slope in (have, (plain, gradient))
    ]
    for one, other in zip(*by_learned, strict=True):
        _same("in a decoder: a loss of the gradient has a wrong derivative", one, other)
    assert by_learned[1][0].abs().max() > 0, "in a decoder: the field does not depend on the code"


def _same(what: str, have: Tensor, want: Tensor) -> None:
    error, size = (have - want).abs().max(), want.abs().max()
    assert error <= TOLERANCE * (size + TOLERANCE), f"{what}: off by {error:.1e}, of {size:.1e} at most"


def _difference(function: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    with torch.no_grad():
        return (function(x + STEP) - function(x - STEP)) / (2 * STEP)


def _transposed(function: Callable[[Tensor], Tensor], at: Tensor, cotangent: Tensor) -> Tensor:
    """J^T cotangent by differences along each axis of the last dimension of `at`."""
    with torch.no_grad():
        axes = [STEP * direction for direction in torch.eye(at.shape[-1], dtype=at.dtype)]
        columns = [(function(at + axis) - function(at - axis)) / (2 * STEP) for axis in axes]
        return torch.stack([(column * cotangent).sum(-1) for column in columns], dim=-1)


def _gradient(value: Tensor, by: Tensor) -> Tensor:
    """Autograd's d(sum of value) / d(by); zeros where it takes the value for a constant."""
    if not value.requires_grad:
        return torch.zeros_like(by)
    return torch.autograd.grad(value.sum(), by, retain_graph=True, materialize_grads=True, allow_unused=True)[
        0
    ]


def _check_weights(name: str, module: nn.Module, objective: Callable[[], Tensor]) -> None:
    """Compares the gradient of an objective with differences, at up to four numbers of each weight."""
    for key, weight in module.named_parameters():
        if not weight.requires_grad:
            continue
        have, numbers = _gradient(objective(), weight).flatten(), weight.detach().view(-1)
        for index in have.abs().argsort(descending=True)[:4].tolist():
            ends = []
            for step in (STEP, -STEP):
                numbers[index] += step
                ends.append(objective().detach())
                numbers[index] -= step
            _same(f"{name}: wrong second derivative by {key}", have[index], (ends[0] - ends[1]) / (2 * STEP))


def _check_dtype(
    name: str, module: nn.Module, function: Callable[[Tensor], Iterable[Tensor]], at: Tensor
) -> None:
    """Checks that float32 gives float32, and float64 float64."""
    for dtype in (torch.float32, torch.double):
        module.to(dtype)
        kinds = {part.dtype for part in function(at.detach().to(dtype))}
        assert kinds == {dtype}, f"{name}: gives {kinds} of {dtype}"


def _check_modes(name: str, function: Callable[[], Iterable[Tensor]]) -> None:
    """Checks that nothing changes where gradients are off."""
    want = [part.detach() for part in function()]
    for mode in (torch.no_grad(), torch.inference_mode()):
        with mode:
            for one, other in zip(function(), want, strict=True):
                _same(f"{name}: gives something else without gradients", one, other)


def _shake(module: nn.Module) -> None:
    """Moves weights off their start: where they are 0, a wrong derivative does not show."""
    with torch.no_grad():
        for weight in module.parameters():
            weight += 0.05 * torch.randn_like(weight)
