"""The training objective: clamped L1 + prior of the codes + normal term, and its parts by name.

A rival is a subclass of `Loss` that overrides `__call__` or, to have its terms logged apart, `parts`.
"""

from typing import Annotated, Any, Literal

import torch
from pydantic import Field, NonNegativeFloat, PositiveFloat
from pydantic.dataclasses import dataclass
from torch import Tensor

from sdfhub.described import Described

Share = Annotated[float, Field(ge=0, le=1)]


def clamped_l1(predicted: Tensor, target: Tensor, delta: float, far_weight: float = 1.0) -> Tensor:
    """Mean of |clamp(f, delta) - clamp(d, delta)| of field values and signed distances, [B, N]: a scalar.

    Where the target lies beyond delta the error counts `far_weight` times.

    A prediction outside [-delta, delta] whose target lies outside on the same side gets no gradient.

    Source: the paper's L1 loss (Park et al. 2019, equation 4).
    """
    errors = (predicted.clamp(-delta, delta) - target.clamp(-delta, delta)).abs()
    if far_weight != 1:
        errors = torch.where(target.abs() > delta, far_weight * errors, errors)
    return errors.mean()


def code_prior(codes: Tensor, norm: Literal["squared", "l2"]) -> Tensor:
    """Mean over the shapes of codes [B, L] of |z|^2 (both papers) or |z| (DeepSDF's code): a scalar."""
    squared = codes.square().sum(dim=-1)
    # the floor keeps the derivative of the root finite at z = 0
    return squared.mean() if norm == "squared" else squared.clamp(min=1e-12).sqrt().mean()


def normal_term(gradients: Tensor, normals: Tensor) -> Tensor:
    """Mean over points of |grad_x f - n|^2, both [B, M, 3]: a scalar. Source: the paper's final loss."""
    return (gradients - normals).square().sum(dim=-1).mean()


class Loss(Described):
    """What a training lowers."""

    delta: float = 0.1
    """Half-width of the band in which distances count, > 0, also in fits of unseen shapes."""

    def wants_gradients(self, progress: float) -> bool:
        """Whether spatial gradients are given at this share of training, in [0, 1]; they cost time."""
        return False

    def __call__(self, *arguments: Any, **named: Any) -> Tensor:
        """The loss, a scalar; arguments as in `parts`."""
        return torch.stack(tuple(self.parts(*arguments, **named).values())).sum()

    def parts(
        self,
        predicted: Tensor,
        target: Tensor,
        codes: Tensor,
        gradients: Tensor | None,
        normals: Tensor | None,
        progress: float,
    ) -> dict[str, Tensor]:
        """Weighted terms by name; their sum is the loss.

        A large batch is worked on in pieces, so a term is a mean: over surface points for one named
        `normal`, else over samples or shapes.

        Args:
            predicted: [B, N] field values.
            target: [B, N] signed distances, normalised frame.
            codes: [B, L].
            gradients: [B, M, 3] spatial gradients on the surface, or None where they are not wanted.
            normals: [B, M, 3] outward unit normals there, or None.
            progress: share of training done, in [0, 1].
        """
        return {"objective": self(predicted, target, codes, gradients, normals, progress)}


@dataclass(frozen=True, kw_only=True)
class SdfLoss(Loss):
    """Clamped L1 + lambda_code * prior of the codes + tau * normal term.

    Sums over points in the paper are means here, so that weights do not depend on the batch.
    """

    delta: PositiveFloat = 0.1  # clamp of signed distances, normalised frame
    far_weight: PositiveFloat = 1.0  # of errors beyond delta, where pieces float that no near sample sees
    lambda_code: NonNegativeFloat = 1e-4  # weight of the code prior
    code_norm: Literal["squared", "l2"] = "squared"  # |z|^2 or |z|
    warmup: Share = 0.05  # share of training over which lambda_code grows linearly from 0
    tau: NonNegativeFloat = 0.01  # weight of the normal term; 0 switches it off
    tau_start: Annotated[float, Field(ge=0, lt=1)] = 0.0  # share of training before which tau is 0

    def wants_gradients(self, progress: float) -> bool:
        return self.tau > 0 and progress >= self.tau_start

    def parts(self, predicted, target, codes, gradients, normals, progress) -> dict[str, Tensor]:
        """The parts `sdf`, `code` and, where gradients are given, `normal`."""
        warmup = min(1.0, progress / self.warmup) if self.warmup else 1.0
        parts = {"sdf": clamped_l1(predicted, target, self.delta, self.far_weight)}
        parts["code"] = self.lambda_code * warmup * code_prior(codes, self.code_norm)
        if gradients is not None and normals is not None:
            parts["normal"] = self.tau * normal_term(gradients, normals)
        return parts
