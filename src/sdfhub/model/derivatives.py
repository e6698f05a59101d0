"""Derivatives by autograd of what states none of its own: an activation's slope, an encoding's Jacobian.

Neither is traced by `torch.compile`, which cannot differentiate twice what it has compiled once.
"""

from collections.abc import Callable

import torch
from torch import Tensor


@torch.compiler.disable
def value_and_pullback(
    function: Callable[[Tensor], Tensor], at: Tensor
) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
    """f(x), and the map of a cotangent v, shaped like f(x), to J(x)^T v, shaped like x.

    Both are differentiable where gradients are on; where they are off, or in inference mode, both are plain
    numbers.

    Args:
        function: twice differentiable.
        at: x, any shape.
    """
    differentiable = torch.is_grad_enabled()
    with torch.inference_mode(False), torch.enable_grad():
        leaf = at if differentiable and at.requires_grad else at.detach().clone().requires_grad_()
        value = function(leaf)

    @torch.compiler.disable
    def pullback(cotangent: Tensor) -> Tensor:
        if not value.requires_grad:  # a constant function
            return torch.zeros_like(leaf)
        return torch.autograd.grad(
            value, leaf, cotangent, retain_graph=True, create_graph=differentiable, materialize_grads=True
        )[0]

    return value if differentiable else value.detach(), pullback


def value_and_slope(function: Callable[[Tensor], Tensor], at: Tensor) -> tuple[Tensor, Tensor]:
    """f(x) and f'(x), both shaped like x, of an elementwise function; differentiable as above."""
    value, pullback = value_and_pullback(function, at)
    return value, pullback(torch.ones_like(value))
