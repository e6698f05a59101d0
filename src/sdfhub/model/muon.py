"""Muon: steps of a matrix along the nearest orthogonal one, so that no direction of it lags behind."""

from collections.abc import Callable, Iterable
from typing import Any

import torch


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
        groups = [{"matrices": False} | group for group in params]
        of_matrices: dict[str, Any] = {"weight_decay": 0.0, "momentum": momentum}
        of_matrices["adjust_lr_fn"] = "match_rms_adamw"
        matrices = [group for group in groups if group["matrices"]]
        rest = [group for group in groups if not group["matrices"]]
        self._inner: dict[bool, torch.optim.Optimizer] = {}  # they fill in what a group does not say
        if matrices:
            self._inner[True] = torch.optim.Muon(matrices, lr=lr, **of_matrices)
        if rest:
            self._inner[False] = torch.optim.Adam(rest, lr=lr, betas=betas, fused=True)
        super().__init__(groups, {})

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        loss = None
        if closure:
            with torch.enable_grad():
                loss = closure()
        for is_of_matrices, optimizer in self._inner.items():
            # both were replaced where a checkpoint was loaded
            groups = [group for group in self.param_groups if group["matrices"] == is_of_matrices]
            optimizer.param_groups, optimizer.state = groups, self.state
            optimizer.step()
        return loss
