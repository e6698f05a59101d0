"""Checks for rivals of one's own: `check_derivatives(MyActivation, a=2.0)` raises where one is wrong."""

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from sdfhub.model.activations import Activation, new_activation
from sdfhub.model.conditioning import Layer
from sdfhub.model.encodings import Encoding, as_encoding

TOLERANCE = 1e-4
"""How far derivatives may be off, of the largest one, in float64."""


def check_derivatives(make: Any, **settings: Any) -> None:
    """Checks an activation, an encoding or a conditioning against differences in float64.

    Values, first derivatives, the derivatives of those by points, codes and weights (which a loss of normals
    needs), shapes, dtypes and finite numbers.

    Args:
        make: a class, a partial of one, or an instance: an `Activation` or elementwise module, an `Encoding`
            or module with `features`, or a class of `Layer`.
        settings: arguments of the class.

    Raises:
        AssertionError: says what is wrong.
    """
    make = partial(make, **settings) if settings else make
    torch.manual_seed(0)
    kind = getattr(make, "func", make)
    is_activation = isinstance(kind, type) and issubclass(kind, Activation)
    if isinstance(kind, type) and issubclass(kind, Layer):
        for hidden, code in ((6, 4), (0, 4), (6, 0)):
            _check_layer(_shaken(make(hidden, 3, code, 5)), code)
    elif hasattr(module := make if isinstance(make, nn.Module) or is_activation else make(), "features"):
        _check_encoding(_shaken(as_encoding(module)))
    else:
        for first in (True, False):
            _check_activation(new_activation(make, first).double())


def _check_activation(activation: Activation) -> None:
    name = type(getattr(activation, "function", activation)).__name__
    x = torch.randn(2, 5, 4, dtype=torch.double, requires_grad=True)
    value = activation(x)
    assert value.shape == x.shape, f"{name}: forward gives {list(value.shape)} of {list(x.shape)}"
    _same(f"{name}: is not elementwise", activation(x[..., :1].contiguous()), value[..., :1])
    at_zero = activation.with_slope(torch.zeros_like(x))
    assert all(part.isfinite().all() for part in at_zero), f"{name}: value or slope at 0 is not finite"
    have, slope = activation.with_slope(x)
    _same(f"{name}: with_slope gives another value than forward", have, value)
    _check_gradient(f"{name}: forward has a wrong derivative", activation, x)
    _same(f"{name}: with_slope gives a wrong slope", slope, torch.autograd.grad(value.sum(), x)[0])
    _check_gradient(
        f"{name}: the slope has a wrong derivative", activation, x, lambda x: activation.with_slope(x)[1]
    )
    _check_kinds(name, activation, activation.with_slope, x)
    bounds = activation.weight_bound(64), activation.bias_bound()
    assert all(bound is None or 0 < bound < float("inf") for bound in bounds), (
        f"{name}: weight_bound and bias_bound must be positive, got {bounds[0]} and {bounds[1]}"
    )


def _check_encoding(encoding: Encoding) -> None:
    name = type(getattr(encoding, "module", encoding)).__name__
    points = (torch.rand(2, 5, 3, dtype=torch.double) * 1.6 - 0.8).requires_grad_()
    value, shape = encoding(points), [2, 5, encoding.features]
    assert list(value.shape) == shape, f"{name}: features {list(value.shape)}, expected {shape}"
    for place in (torch.zeros_like(points), points * 1.6):
        assert encoding(place).isfinite().all(), f"{name}: features at 0 or outside the cube are not finite"
    cotangent = torch.randn_like(value)

    def pulled(points: Tensor) -> tuple[Tensor, Tensor]:
        features, pullback = encoding.with_pullback(points)
        return features, pullback(cotangent.to(points.dtype))

    features, by_points = pulled(points)
    _same(f"{name}: with_pullback gives other features than forward", features, value)
    _check_gradient(f"{name}: forward has a wrong derivative", encoding, points)
    _same(f"{name}: the pullback is wrong", by_points, torch.autograd.grad(value, points, cotangent)[0])
    _check_gradient(f"{name}: wrong second derivative", encoding, points, lambda points: pulled(points)[1])
    _check_kinds(name, encoding, pulled, points)


def _check_layer(layer: Layer, code: int) -> None:
    name, (hidden, encoding, _) = type(layer).__name__, layer.columns
    inputs = torch.randn(2, 5, hidden + encoding, dtype=torch.double, requires_grad=True)
    codes = torch.randn(2, 4, dtype=torch.double, requires_grad=True)
    product, shift = layer(inputs, codes)
    assert list(product.shape) == [2, 5, 5], f"{name}: product {list(product.shape)}, expected [2, 5, 5]"
    assert shift.shape in ((5,), (2, 1, 5)), f"{name}: shift {list(shift.shape)}, expected [5] or [2, 1, 5]"
    if code:
        by_code = torch.autograd.grad((product + shift).square().sum(), codes, retain_graph=True)[0]
        assert by_code.abs().max() > 0, f"{name}: does not depend on the code"
    twice = layer(2 * inputs, codes)
    _same(f"{name}: the product is not linear in its inputs", twice[0], 2 * product)
    _same(f"{name}: the shift depends on the inputs", twice[1], shift)
    cotangent = torch.randn_like(product, requires_grad=True)
    parts = layer.pullback(cotangent, codes)
    for part, size in zip(parts, (hidden, encoding), strict=True):
        assert (part is None) == (size == 0), f"{name}: pullback must give None for what is not read, alone"

    def pulled(cotangent: Tensor) -> Tensor:
        return torch.cat([part for part in layer.pullback(cotangent, codes) if part is not None], dim=-1)

    _same(
        f"{name}: the pullback is wrong",
        pulled(cotangent),
        torch.autograd.grad(product, inputs, cotangent)[0],
    )
    _check_gradient(f"{name}: wrong second derivative", layer, cotangent, pulled)


def _same(what: str, have: Tensor, want: Tensor) -> None:
    error, size = (have - want).abs().max(), want.abs().max()
    assert error <= TOLERANCE * (size + TOLERANCE), f"{what}: off by {error:.1e}, of {size:.1e} at most"


def _check_gradient(
    what: str, module: nn.Module, at: Tensor, function: Callable[[Tensor], Tensor] | None = None
) -> None:
    """Compares the gradient of a function (the module's own) by its argument and weights with differences."""
    weights = [weight for weight in module.parameters() if weight.requires_grad]
    call = lambda at, *_: (function or module)(at)  # noqa: E731 # gradcheck moves the weights where they are
    try:
        torch.autograd.gradcheck(call, (at, *weights), atol=TOLERANCE, rtol=TOLERANCE, fast_mode=True)
    except RuntimeError as error:
        raise AssertionError(f"{what}: {str(error).splitlines()[0]}") from error


def _check_kinds(
    name: str, module: nn.Module, function: Callable[[Tensor], Iterable[Tensor]], at: Tensor
) -> None:
    """Checks that nothing changes where gradients are off, and that float32 gives float32."""
    want = [part.detach() for part in function(at)]
    for mode in (torch.no_grad(), torch.inference_mode()):
        with mode:
            for have, wanted in zip(function(at), want, strict=True):
                _same(f"{name}: gives something else without gradients", have, wanted)
    for dtype in (torch.float32, torch.double):
        module.to(dtype)
        dtypes = {part.dtype for part in function(at.detach().to(dtype))}
        assert dtypes == {dtype}, f"{name}: gives {dtypes} of {dtype}"


def _shaken(module: Any) -> Any:
    """In float64, with weights off their start: where they are 0, a wrong derivative does not show."""
    with torch.no_grad():
        for weight in module.double().parameters():
            weight += 0.05 * torch.randn_like(weight)
    return module
