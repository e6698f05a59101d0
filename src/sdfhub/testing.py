"""Checks for rivals of one's own: `check_derivatives(MyActivation, a=2.0)` raises where one is wrong."""

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from sdfhub.model.activations import Activation, new_activation
from sdfhub.model.conditioning import Layer
from sdfhub.model.encodings import Encoding, as_encoding

TOLERANCE = 1e-4  # how far derivatives may be off, of the largest one, in float64
Pair = Callable[[Tensor], tuple[Tensor, Tensor]]


def check_derivatives(make: Any, **settings: Any) -> None:
    """Checks an activation, an encoding or a conditioning; an `AssertionError` says what is wrong.

    First derivatives, and those of these by points, codes and weights (which a loss of normals needs),
    against differences in float64; shapes, dtypes, finite numbers.

    Args:
        make: a class, a partial or an instance: an `Activation` or elementwise module, an `Encoding` or
            module with `features`, or a class of `Layer`.
        settings: arguments of the class.
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
    _check_pair(f"{name}: with_slope", activation, x, activation.with_slope, torch.ones_like(x))
    for bound in (activation.weight_bound(64), activation.bias_bound()):
        assert bound is None or 0 < bound < float("inf"), f"{name}: a bound must be positive, got {bound}"


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

    _check_pair(f"{name}: with_pullback", encoding, points, pulled, cotangent)


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
    for part, size in zip(layer.pullback(cotangent, codes), (hidden, encoding), strict=True):
        assert (part is None) == (size == 0), f"{name}: pullback must give None for what is not read, alone"

    def pulled(cotangent: Tensor) -> Tensor:
        return torch.cat([part for part in layer.pullback(cotangent, codes) if part is not None], dim=-1)

    want = torch.autograd.grad(product, inputs, cotangent)[0]
    _same(f"{name}: pullback gives a wrong derivative", pulled(cotangent), want)
    _check_gradient(f"{name}: pullback has a wrong derivative", layer, cotangent, pulled)


def _check_pair(what: str, module: nn.Module, at: Tensor, pair: Pair, cotangent: Tensor) -> None:
    """Checks the value and its pulled back cotangent: derivatives of both, without gradients, in float32."""
    have, pulled = pair(at)
    value = module(at)
    _same(f"{what} gives another value than forward", have, value)
    _same(f"{what} gives a wrong derivative", pulled, torch.autograd.grad(value, at, cotangent)[0])
    _check_gradient(f"{what}: forward has a wrong derivative", module, at, module)
    _check_gradient(f"{what} has a wrong derivative", module, at, lambda at: pair(at)[1])
    for mode in (torch.no_grad(), torch.inference_mode()):
        with mode:
            for plain, wanted in zip(pair(at), (have, pulled), strict=True):
                _same(f"{what} gives something else without gradients", plain, wanted.detach())
    for dtype in (torch.float32, torch.double):
        module.to(dtype)
        dtypes = {part.dtype for part in pair(at.detach().to(dtype))}
        assert dtypes == {dtype}, f"{what} gives {dtypes} of {dtype}"


def _same(what: str, have: Tensor, want: Tensor) -> None:
    error, size = (have - want).abs().max(), want.abs().max()
    assert error <= TOLERANCE * (size + TOLERANCE), f"{what}: off by {error:.1e}, of {size:.1e} at most"


def _check_gradient(what: str, module: nn.Module, at: Tensor, function: Callable[[Tensor], Tensor]) -> None:
    """Compares the gradient of a function by its argument and a module's weights with differences."""
    weights = [weight for weight in module.parameters() if weight.requires_grad]
    call = lambda at, *_: function(at)  # noqa: E731 # gradcheck moves the weights where they are
    try:
        torch.autograd.gradcheck(call, (at, *weights), atol=TOLERANCE, rtol=TOLERANCE, fast_mode=True)
    except RuntimeError as error:
        raise AssertionError(f"{what}: {' '.join(str(error).split())[:160]}") from error


def _shaken(module: Any) -> Any:
    """In float64, with weights off their start: where they are 0, a wrong derivative does not show."""
    with torch.no_grad():
        for weight in module.double().parameters():
            weight += 0.05 * torch.randn_like(weight)
    return module
