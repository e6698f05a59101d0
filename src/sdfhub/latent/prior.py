"""What codes are likely before anything is observed: normal distributions, fitted to a code table or not."""

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor


class Normal(NamedTuple):
    """A normal distribution of codes.

    Args:
        mean: [L].
        covariance: [L, L], positive definite.
    """

    mean: Tensor
    covariance: Tensor

    def draw(self, count: int, seed: int) -> Tensor:
        """Codes [count, L]; the same seed gives the same codes on every device."""
        noise = torch.randn(count, len(self.mean), generator=torch.Generator().manual_seed(seed))
        return self.mean + noise.to(self.mean) @ torch.linalg.cholesky(self.covariance).mT

    def unusual(self, codes: Tensor) -> Tensor:
        """[B] squared distances of codes [B, L] to the mean, 1 on average for codes drawn from it.

        Not by the covariance: a scan that says little leaves a code where the prior wants it, and no
        direction of what is left tells strangers better than its length.
        """
        return (codes - self.mean).square().sum(1) / self.covariance.trace()


class Prior(Protocol):
    """How a distribution of codes comes from a table of them."""

    def __call__(self, codes: Tensor) -> Normal:
        """The distribution of codes, given those [S, L] of the training shapes."""


@dataclass(frozen=True)
class GaussianPrior:
    """The normal distribution of the training codes, its covariance shrunk towards an isotropic one.

    With S codes of L numbers the sample covariance knows S - 1 directions at best; what it lacks, the
    shrinkage gives.

    Source: Ledoit and Wolf 2004, with a given share in place of their estimate.

    Args:
        shrinkage: share of the isotropic covariance (the mean variance in all directions), 1e-4 to 1: with
            less, few codes leave a covariance that float32 cannot factor.
    """

    shrinkage: float

    def __post_init__(self):
        if not 1e-4 <= self.shrinkage <= 1:
            raise ValueError(f"shrinkage must be in [1e-4, 1], got {self.shrinkage}")

    def __call__(self, codes: Tensor) -> Normal:
        mean = codes.mean(0)
        apart = codes - mean
        sample = apart.mT @ apart / max(1, len(codes) - 1)
        variance = sample.diagonal().mean().clamp(min=1e-6)  # one code alone has none
        isotropic = variance * torch.eye(len(mean), dtype=codes.dtype, device=codes.device)
        return Normal(mean, torch.lerp(sample, isotropic, self.shrinkage))


@dataclass(frozen=True)
class IsotropicPrior:
    """N(0, sigma^2) in every direction, whatever the training codes are.

    Source: Park et al. 2019, equation 10; sigma = 1 makes the penalty a multiple of mean z^2.

    Args:
        sigma: > 0.
    """

    sigma: float

    def __post_init__(self):
        if self.sigma <= 0:
            raise ValueError(f"sigma must be positive, got {self.sigma}")

    def __call__(self, codes: Tensor) -> Normal:
        return Normal(torch.zeros_like(codes[0]), self.sigma**2 * torch.eye(codes.shape[1]).to(codes))
