"""Optimisers that know of hidden matrices what Adam does not: that their entries act together."""

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


class MatrixOptimizer(torch.optim.Optimizer):
    """A rule of its own for hidden matrices, Adam for everything else, as one optimiser.

    Args:
        params: groups of parameters; those of a group with `matrices=True` are all 2D.
        settings: of the rule: defaults of the groups, `lr` among them.
        betas: of Adam.
    """

    takes_matrices = True
    """Whether `Optimisation` gives it the decoder's hidden matrices as a group of their own."""

    def __init__(
        self, params: Iterable[dict[str, Any]], settings: dict[str, Any], betas: tuple[float, float]
    ):
        groups = [{"matrices": False, "lr": settings["lr"]} | group for group in params]
        rest = [group for group in groups if not group["matrices"]]
        self._adam = torch.optim.Adam(rest, betas=betas, fused=True)  # fills in what its groups do not say
        super().__init__(groups, settings)

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
                    self.step_matrix(matrix, matrix.grad, self.state[matrix], group)
        return loss

    def step_matrix(
        self, matrix: Tensor, gradient: Tensor, state: dict[str, Any], group: dict[str, Any]
    ) -> None:
        """The rule: changes a matrix [M, N] by its gradient, what is remembered of it, and its settings."""
        raise NotImplementedError


class Muon(MatrixOptimizer):
    """Steps of hidden matrices along the nearest orthogonal one, so that no direction of them lags behind.

    A step has the root mean square of one of Adam's with the same rate.

    Source: Jordan et al. 2024 (Muon); Liu et al. 2025, section 2.2, for the size of a step; McGinnis et al.
    2025, who use it for fields.

    Args:
        params: groups of parameters; those of a group with `matrices=True` are all 2D.
        lr: of matrices, > 0.
        momentum: of the matrices, in [0, 1).
        betas: of Adam.
    """

    def __init__(
        self,
        params: Iterable[dict[str, Any]],
        lr: float = 4e-3,
        momentum: float = 0.95,
        betas: tuple[float, float] = (0.9, 0.999),
    ):
        super().__init__(params, {"lr": lr, "momentum": momentum}, betas)

    def step_matrix(self, matrix, gradient, state, group):
        momentum = group["momentum"]
        mean = state.setdefault("momentum", torch.zeros_like(matrix)).lerp_(gradient, 1 - momentum)
        ahead = gradient.lerp(mean, momentum)  # Nesterov's
        matrix.add_(orthogonalized(ahead), alpha=-group["lr"] * 0.2 * math.sqrt(max(matrix.shape)))


class Soap(MatrixOptimizer):
    """Adam for hidden matrices in a basis where their entries hardly depend on each other.

    The basis is that of the eigenvectors of mean G G^T and mean G^T G, of gradients G; it is followed by a
    step of the power method every so often.

    Source: Vyas et al. 2024 (SOAP), algorithm 3.

    Args:
        params: groups of parameters; those of a group with `matrices=True` are all 2D.
        lr: of matrices, > 0.
        beta: of all averages that matrices have, in [0, 1).
        every: steps from one turn of the basis to the next.
        betas: of Adam.
    """

    def __init__(
        self,
        params: Iterable[dict[str, Any]],
        lr: float = 3e-3,
        beta: float = 0.95,
        every: int = 10,
        betas: tuple[float, float] = (0.9, 0.999),
    ):
        super().__init__(params, {"lr": lr, "beta": beta, "every": every}, betas)

    def step_matrix(self, matrix, gradient, state, group):
        beta, products = group["beta"], (gradient @ gradient.T, gradient.T @ gradient)
        if not state:
            state |= {"steps": 0, "mean": torch.zeros_like(matrix), "square": torch.zeros_like(matrix)}
            state["products"] = [torch.zeros_like(product) for product in products]
            state["bases"] = [torch.linalg.eigh(product).eigenvectors for product in products]
        for mean, product in zip(state["products"], products, strict=True):
            mean.lerp_(product, 1 - beta)
        if state["steps"] and state["steps"] % group["every"] == 0:
            pairs = zip(state["products"], state["bases"], strict=True)
            state["bases"] = [torch.linalg.qr(product @ basis).Q for product, basis in pairs]
        left, right = state["bases"]
        state["steps"] += 1
        unbiased = 1 - beta ** state["steps"]
        square = state["square"].lerp_((left.T @ gradient @ right).square(), 1 - beta) / unbiased
        mean = left.T @ state["mean"].lerp_(gradient, 1 - beta) @ right / unbiased
        matrix.add_(left @ (mean / (square.sqrt() + 1e-8)) @ right.T, alpha=-group["lr"])
