"""Damped Gauss-Newton steps for many small problems side by side."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor


class Quadratic(NamedTuple):
    """B objectives about their unknowns: value [B], gradient [B, U], positive definite hessian [B, U, U]."""

    value: Tensor
    gradient: Tensor
    hessian: Tensor


ROWS_AT_ONCE = 2**12  # rows differentiated at a time on a CPU, by each thread; bounds memory


def values_and_jacobian(
    function: Callable[..., Tensor], unknowns: Tensor, *inputs: Tensor
) -> tuple[Tensor, Tensor]:
    """Values [R] and their derivatives [R, U] of rows that each depend on unknowns of their own alone.

    So one backward pass gives every row.

    Args:
        function: maps unknowns [r, U] and inputs of r rows to values [r].
        unknowns: [R, U].
        inputs: [R, ...] each.
    """
    size, pairs = ROWS_AT_ONCE if unknowns.is_cpu else max(1, len(unknowns)), []
    for part, *arguments in zip(unknowns.split(size), *(array.split(size) for array in inputs), strict=True):
        with torch.enable_grad():
            part = part.detach().requires_grad_()
            values = function(part, *arguments)
            pairs.append((values.detach(), *torch.autograd.grad(values.sum(), part)))
    values, jacobian = (torch.cat(column) for column in zip(*pairs, strict=True))
    return values, jacobian


def descend(
    objective: Callable[[Tensor, Tensor], Quadratic],
    unknowns: Tensor,
    damping: Tensor,
    steps: int,
    tolerance: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """Unknowns [B, U] after at most `steps` steps, the damping [B] to go on with, the objectives [B] there.

    A step that does not lower the true objective is not taken, and the next is damped more.

    Source: Levenberg 1944 and Marquardt 1963.

    Args:
        objective: of rows [b] of the B problems at their unknowns [b, U].
        unknowns: [B, U] where to start.
        damping: [B], in units of the Hessians' mean diagonals.
        steps: >= 1.
        tolerance: a problem is done when a step lowers its objective by a smaller share.
    """
    unknowns, damping = unknowns.clone(), damping.clone()
    left = torch.arange(len(unknowns), device=unknowns.device)  # problems that are not done
    here = objective(left, unknowns)
    for _ in range(steps):
        trial = unknowns[left] + _step(here.gradient[left], here.hessian[left], damping[left])
        there = objective(left, trial)
        gain = here.value[left] - there.value
        lower = gain > 0  # false where there is no number
        damping[left] = torch.where(lower, damping[left] * 0.3, damping[left] * 4).clamp(1e-5, 1e6)
        done = lower & (gain < tolerance * here.value[left])
        better = left[lower]
        unknowns[better] = trial[lower]
        for old, new in zip(here, there, strict=True):
            old[better] = new[lower]
        left = left[~done]
        if not len(left):
            break
    return unknowns, damping, here.value


def _step(gradient: Tensor, hessian: Tensor, damping: Tensor) -> Tensor:
    """Where to go [B, U]: the minimum of a quadratic, shortened by damping [B]."""
    diagonal = hessian.diagonal(dim1=1, dim2=2)
    damped = hessian + torch.diag_embed((damping * diagonal.mean(1))[:, None].expand_as(diagonal))
    return -torch.linalg.solve_ex(damped, gradient).result  # unlike solve, lets what is no number pass
