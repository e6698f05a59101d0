"""Derivatives by autograd, for activations, encodings and layers that state none of their own."""

from collections.abc import Callable

import torch
from torch import Tensor

Pullback = Callable[[Tensor], Tensor]  # from a cotangent of a function's value to one of its argument


@torch.compiler.disable  # which cannot differentiate twice what it has compiled once
def value_and_pullback(function: Callable[[Tensor], Tensor], at: Tensor) -> tuple[Tensor, Pullback]:
    """f(x), and the map of a cotangent v of f(x) to J(x)^T v; differentiable where gradients are on."""
    differentiable = torch.is_grad_enabled()
    with torch.inference_mode(False), torch.enable_grad():
        leaf = at if differentiable and at.requires_grad else at.detach().clone().requires_grad_()
        value = function(leaf)

    @torch.compiler.disable
    def pullback(cotangent: Tensor) -> Tensor:
        if not value.requires_grad:  # a constant function
            return torch.zeros_like(leaf)
        settings = {"retain_graph": True, "create_graph": differentiable, "materialize_grads": True}
        return torch.autograd.grad(value, leaf, cotangent, **settings)[0]

    return value if differentiable else value.detach(), pullback
