"""How a space's codes are distributed: a Gaussian along their principal axes."""

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class CodeDistribution:
    """A Gaussian fitted to codes: z = mean + u axes, u from N(0, 1).

    Args:
        mean: [L].
        axes: [K, L], orthogonal, each one standard deviation long, the longest first. The entry of an axis
            that is largest in size is positive, so that every machine finds the same ones.
    """

    mean: Tensor
    axes: Tensor

    @classmethod
    def of(cls, codes: Tensor) -> "CodeDistribution":
        """The distribution of codes [S, L] by their principal components: K = min(S - 1, L) axes.

        >>> codes = torch.tensor([[0.0, 0.0], [3.0, 0.0], [0.0, 1.0], [3.0, 1.0]])
        >>> CodeDistribution.of(codes).mean
        tensor([1.5000, 0.5000])
        """
        precise = codes.detach().double()
        mean = precise.mean(0)
        count = min(len(codes) - 1, codes.shape[1])
        _, lengths, directions = torch.linalg.svd(precise - mean, full_matrices=False)
        axes = (directions * lengths[:, None] / max(len(codes) - 1, 1) ** 0.5)[:count]
        largest = axes.gather(1, axes.abs().argmax(1, keepdim=True))
        return cls(mean.to(codes.dtype), (axes * largest.sign()).to(codes.dtype))

    def sample(self, count: int, seed: int = 0) -> Tensor:
        """Codes [count, L] drawn from it; the same for the same seed on every device."""
        noise = torch.randn(count, len(self.axes), generator=torch.Generator().manual_seed(seed))
        return self.mean + noise.to(self.axes) @ self.axes
