"""Muon: steps of a matrix along the nearest orthogonal one, so that no direction of it lags behind."""

import math
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor

QUINTIC = (3.4445, -4.7750, 2.0315)  # a x + b x^3 + c x^5: five times, singular values come to .7 to 1.2
ITERATIONS = 5


def orthogonalized(matrix: Tensor) -> Tensor:
    """U p(S) V^T of a matrix U S V^T [M, N], with all of p(S) near 1, by Newton-Schulz iterations.

    On a CPU in float32: without instructions for bfloat16, PyTorch's own takes far longer.

    Source: Jordan et al. 2024 (Muon).
    """
    a, b, c = QUINTIC
    x = matrix if matrix.is_cpu else matrix.bfloat16()
    x = x.T if len(x) > x.shape[1] else x
    x = x / x.norm().clamp(min=1e-7)
    for _ in range(ITERATIONS):
        square = x @ x.T
        x = torch.addmm(x, torch.addmm(square, square, square, beta=b, alpha=c), x, beta=a)
    return (x.T if len(matrix) > matrix.shape[1] else x).to(matrix.dtype)


class Muon(torch.optim.Optimizer):
    """Muon on the hidden matrices, Adam on everything else, as one optimiser.

    A step of a matrix has the root mean square of one of Adam's with the same rate.

    Source: Jordan et al. 2024 (Muon); Liu et al. 2025, section 2.2, for the size of a step; McGinnis et al.
    2025, who use it for fields.

    Args:
        params: groups of parameters; those of a group with `matrices=True` are all 2D.
        lr: of matrices whose group names none, > 0.
        momentum: of the matrices, in [0, 1).
        betas: of Adam.
    """

    takes_matrices = True
    """Whether `Optimisation` gives it the decoder's hidden matrices as a group of their own."""

    def __init__(
        self,
        params: Iterable[dict[str, Any]],
        lr: float = 4e-3,
        momentum: float = 0.95,
        betas: tuple[float, float] = (0.9, 0.999),
    ):
        groups = [{"matrices": False, "lr": lr} | group for group in params]
        rest = [group for group in groups if not group["matrices"]]
        self._adam = torch.optim.Adam(rest, betas=betas, fused=True)  # fills in what its groups do not say
        super().__init__(groups, {"momentum": momentum})

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        loss = None
        if closure:
            with torch.enable_grad():
                loss = closure()
        # a loaded checkpoint has replaced both
        self._adam.param_groups = [group for group in self.param_groups if not group["matrices"]]
        self._adam.state = self.state
        self._adam.step()
        for group in self.param_groups:
            for matrix in group["params"] if group["matrices"] else ():
                if matrix.grad is not None:
                    self._step(matrix, group["lr"], group["momentum"])
        return loss

    def _step(self, matrix: Tensor, lr: float, momentum: float) -> None:
        state = self.state[matrix]
        gradient: Tensor = matrix.grad  # type: ignore[assignment]
        mean = state.setdefault("momentum", torch.zeros_like(matrix)).lerp_(gradient, 1 - momentum)
        ahead = gradient.lerp(mean, momentum)  # Nesterov's
        matrix.add_(orthogonalized(ahead), alpha=-lr * 0.2 * math.sqrt(max(matrix.shape)))
