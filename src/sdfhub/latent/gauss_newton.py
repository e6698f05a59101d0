"""Damped Gauss-Newton steps for many small problems side by side."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor


class Quadratic(NamedTuple):
    """The objectives of B problems about their unknowns.

    Args:
        value: [B].
        gradient: [B, U].
        hessian: [B, U, U], positive definite.
    """

    value: Tensor
    gradient: Tensor
    hessian: Tensor


AT_ONCE = 2**12
"""Rows differentiated at a time on a CPU, by each thread; bounds memory."""

About = Callable[[Tensor, Tensor], Quadratic]
"""Rows [b] of problems and their unknowns [b, U] -> their objectives there."""


def values_and_jacobian(
    values_of: Callable[..., Tensor], unknowns: Tensor, *given: Tensor
) -> tuple[Tensor, Tensor]:
    """Values [R] and their derivatives [R, U] of rows that each depend on unknowns of their own alone.

    So one backward pass gives every row.

    Args:
        values_of: maps unknowns [r, U] and what is given of as many rows to values [r].
        unknowns: [R, U].
        given: [R, ...] each.
    """
    size, found = AT_ONCE if unknowns.is_cpu else max(1, len(unknowns)), []
    for some, *parts in zip(unknowns.split(size), *(each.split(size) for each in given), strict=True):
        with torch.enable_grad():
            some = some.detach().requires_grad_()
            values = values_of(some, *parts)
            found.append((values.detach(), *torch.autograd.grad(values.sum(), some)))
    values, jacobian = (torch.cat(column) for column in zip(*found, strict=True))
    return values, jacobian


def descend(
    about: About, unknowns: Tensor, damping: Tensor, steps: int, tolerance: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Unknowns [B, U] after at most `steps` steps, the damping [B] to go on with, the objectives [B] there.

    A step that does not lower the true objective is not taken, and the next is damped more.

    Source: Levenberg 1944 and Marquardt 1963.

    Args:
        about: the objectives.
        unknowns: [B, U] where to start.
        damping: [B], in units of the Hessians' mean diagonals.
        steps: >= 1.
        tolerance: a problem is done when a step lowers its objective by a smaller share.
    """
    unknowns, damping = unknowns.clone(), damping.clone()
    left = torch.arange(len(unknowns), device=unknowns.device)  # problems that are not done
    at = about(left, unknowns)
    for _ in range(steps):
        tried = unknowns[left] + _step(at.gradient[left], at.hessian[left], damping[left])
        there = about(left, tried)
        gain = at.value[left] - there.value
        lower = gain > 0  # false where there is no number
        damping[left] = torch.where(lower, damping[left] * 0.3, damping[left] * 4).clamp(1e-5, 1e6)
        done = lower & (gain < tolerance * at.value[left])
        better = left[lower]
        unknowns[better] = tried[lower]
        for old, new in zip(at, there, strict=True):
            old[better] = new[lower]
        left = left[~done]
        if not len(left):
            break
    return unknowns, damping, at.value


def _step(gradient: Tensor, hessian: Tensor, damping: Tensor) -> Tensor:
    """Where to go [B, U]: the minimum of a quadratic, shortened by damping [B]."""
    diagonal = hessian.diagonal(dim1=1, dim2=2)
    damped = hessian + torch.diag_embed((damping * diagonal.mean(1))[:, None].expand_as(diagonal))
    return -torch.linalg.solve_ex(damped, gradient).result  # unlike solve, lets what is no number pass
