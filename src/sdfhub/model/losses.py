"""The training objective: clamped L1 + prior of the codes + normal term, and its parts by name."""

from dataclasses import dataclass
from typing import Literal

from torch import Tensor


def clamped_l1(predicted: Tensor, target: Tensor, delta: float) -> Tensor:
    """Mean of |clamp(f, delta) - clamp(d, delta)|: a scalar.

    Source: the paper's L1 loss (Park et al. 2019, equation 4). A prediction outside [-delta, delta] whose
    target lies outside on the same side costs nothing and gets no gradient.

    Args:
        predicted: [B, N] field values.
        target: [B, N] signed distances, normalised frame.
        delta: half-width of the band in which distances count, > 0.
    """
    return (predicted.clamp(-delta, delta) - target.clamp(-delta, delta)).abs().mean()


def code_prior(codes: Tensor, norm: Literal["squared", "l2"]) -> Tensor:
    """Mean over shapes of |z|^2 (both papers) or |z| (DeepSDF's published code): a scalar.

    Args:
        codes: [B, L].
        norm: which of the two.
    """
    squared = codes.square().sum(dim=-1)
    # the floor keeps the derivative of the root finite at z = 0
    return squared.mean() if norm == "squared" else squared.clamp(min=1e-12).sqrt().mean()


def normal_term(gradients: Tensor, normals: Tensor) -> Tensor:
    """Mean over points of |grad_x f - n|^2: a scalar. Source: the paper's final loss.

    Args:
        gradients: [B, M, 3] spatial gradients of the field on the surface.
        normals: [B, M, 3] outward unit normals there.
    """
    return (gradients - normals).square().sum(dim=-1).mean()


@dataclass(frozen=True)
class SdfLoss:
    """The weights of the objective, and the objective.

    Sums over points in the paper are means here, so that weights do not depend on the batch.

    Args:
        delta: clamp of signed distances, normalised frame, > 0.
        lambda_code: weight of the code prior, >= 0.
        code_norm: `squared` for |z|^2 or `l2` for |z|.
        warmup: share of training in [0, 1] over which lambda_code grows linearly from 0.
        tau: weight of the normal term, >= 0; 0 switches it off.
        tau_start: share of training in [0, 1) before which tau is 0: normals cost time before they pay.
    """

    delta: float
    lambda_code: float
    code_norm: Literal["squared", "l2"]
    warmup: float
    tau: float
    tau_start: float = 0.0

    def __post_init__(self):
        if self.delta <= 0 or min(self.lambda_code, self.tau) < 0:
            raise ValueError("delta must be positive; lambda_code and tau not negative")
        if not 0 <= self.warmup <= 1:
            raise ValueError(f"warmup must be in [0, 1], got {self.warmup}")
        if not 0 <= self.tau_start < 1:
            raise ValueError(f"tau_start must be in [0, 1), got {self.tau_start}")

    def wants_gradients(self, progress: float) -> bool:
        """Whether the normal term counts at this share of training."""
        return self.tau > 0 and progress >= self.tau_start

    def parts(
        self,
        predicted: Tensor,
        target: Tensor,
        codes: Tensor,
        gradients: Tensor | None,
        normals: Tensor | None,
        progress: float,
    ) -> dict[str, Tensor]:
        """The weighted parts `sdf`, `code` and, where gradients are given, `normal`; their sum is the loss.

        Args:
            predicted: [B, N]; target: [B, N]; codes: [B, L].
            gradients: [B, M, 3] or None; normals: [B, M, 3] or None.
            progress: share of training done, in [0, 1], for the warm-up of the code prior.
        """
        warmup = min(1.0, progress / self.warmup) if self.warmup else 1.0
        parts = {
            "sdf": clamped_l1(predicted, target, self.delta),
            "code": self.lambda_code * warmup * code_prior(codes, self.code_norm),
        }
        if gradients is not None:
            parts["normal"] = self.tau * normal_term(gradients, normals)
        return parts
