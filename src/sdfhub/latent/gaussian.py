"""The normal distribution of a space's codes."""

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Gaussian:
    """A normal distribution of codes: z = mean + u axes + rest * w, all of u [K] and w [L] from N(0, 1).

    Axes are orthogonal, each one standard deviation long, the longest first. The entry of an axis that is
    largest in size is positive, so that every machine finds the same axes.
    """

    mean: Tensor  # [L]
    axes: Tensor  # [K, L]
    rest: Tensor  # [] standard deviation in every direction besides, >= 0

    @classmethod
    def of(cls, codes: Tensor, shrinkage: float = 0.0) -> "Gaussian":
        """The distribution of codes [S, L] by their principal components: K = min(S - 1, L) axes.

        S codes know S - 1 directions at best; shrinkage in [0, 1], the share of the isotropic covariance (the
        mean variance in all directions), gives those that they lack.

        Source: Ledoit and Wolf 2004, with a given share in place of their estimate.
        """
        precise = codes.detach().double()
        mean = precise.mean(0)
        _, lengths, directions = torch.linalg.svd(precise - mean, full_matrices=False)
        axes = directions * lengths[:, None] / max(len(codes) - 1, 1) ** 0.5
        variance = axes.square().sum() / codes.shape[1]
        axes = axes[: min(len(codes) - 1, codes.shape[1])] * (1 - shrinkage) ** 0.5
        largest = axes.gather(1, axes.abs().argmax(1, keepdim=True))
        rest = (shrinkage * variance.clamp(min=1e-6)).sqrt()  # one code alone has no variance
        return cls(*(part.to(codes.dtype) for part in (mean, axes * largest.sign(), rest)))

    @classmethod
    def isotropic(cls, like: Tensor, sigma: float = 1.0) -> "Gaussian":
        """N(0, sigma^2) in every direction of a code [L]."""
        return cls(torch.zeros_like(like), like.new_zeros(0, len(like)), torch.full_like(like[0], sigma))

    @property
    def covariance(self) -> Tensor:
        """[L, L]."""
        return self.axes.mT @ self.axes + self.rest**2 * torch.eye(len(self.mean)).to(self.mean)

    def sample(self, count: int, seed: int = 0) -> Tensor:
        """Codes [count, L] drawn from it; the same for the same seed on every device."""
        generator = torch.Generator().manual_seed(seed)
        along = torch.randn(count, len(self.axes), generator=generator).to(self.mean)
        besides = torch.randn(count, len(self.mean), generator=generator).to(self.mean)
        return self.mean + along @ self.axes + self.rest * besides

    def unusual(self, codes: Tensor) -> Tensor:
        """[B] squared distances of codes [B, L] to the mean, 1 on average for codes drawn from it."""
        variance = self.axes.square().sum() + self.rest**2 * len(self.mean)
        return (codes - self.mean).square().sum(1) / variance.clamp(min=1e-6 * len(self.mean))
