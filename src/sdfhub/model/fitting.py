"""Codes of shapes that the decoder has not seen: MAP estimation with the decoder frozen."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sdfhub.model.decoder import Decoder
from sdfhub.model.losses import clamped_l1


@dataclass(frozen=True)
class MapFit:
    """argmin over z of the clamped L1 to observed distances plus the Gaussian prior of codes.

    Source: Park et al. 2019, equation 10, and the recipe of its published code: 800 Adam steps, the
    learning rate divided by 10 halfway, z from N(0, 0.01^2), prior 1e-4 * mean z^2.

    Args:
        steps: Adam steps, >= 1.
        lr: initial learning rate, > 0.
        samples: N, signed samples a step and shape, half of them inside.
        spread: standard deviation of the initial codes, >= 0.
        lambda_code: weight of the prior, >= 0.
        delta: clamp of distances, normalised frame, > 0.
        drop_at: share of the steps after which the learning rate is divided by 10.
    """

    steps: int
    lr: float
    samples: int
    spread: float
    lambda_code: float
    delta: float
    drop_at: float = 0.5

    def __post_init__(self):
        if min(self.steps, self.samples) < 1 or min(self.lr, self.delta) <= 0:
            raise ValueError("fit: steps and samples must be at least 1, lr and delta positive")

    def __call__(
        self, decoder: Decoder, draw: Callable[[int], tuple[Tensor, Tensor]], seeds: Sequence[int]
    ) -> Tensor:
        """Codes [B, L] of B shapes, fitted side by side; each depends on its own shape alone.

        Args:
            decoder: stays as it is; its mode is restored.
            draw: step number -> points [B, N, 3] and sdf [B, N].
            seeds: of the B initial codes, one each, so that a code does not depend on its neighbours.
        """
        training, frozen = decoder.training, [p for p in decoder.parameters() if p.requires_grad]
        decoder.eval()
        for parameter in frozen:
            parameter.requires_grad_(False)
        try:
            return self._optimize(decoder, draw, seeds)
        finally:
            for parameter in frozen:
                parameter.requires_grad_(True)
            decoder.train(training)

    @torch.enable_grad()
    def _optimize(self, decoder: Decoder, draw, seeds: Sequence[int]) -> Tensor:
        generators = [torch.Generator().manual_seed(seed) for seed in seeds]
        start = torch.stack([torch.randn(decoder.code_size, generator=each) for each in generators])
        device = next(decoder.parameters()).device
        codes = (start * self.spread).to(device).requires_grad_()
        optimizer = torch.optim.Adam([codes], lr=self.lr)
        for step in range(self.steps):
            if step == math.ceil(self.steps * self.drop_at):
                optimizer.param_groups[0]["lr"] = self.lr / 10
            points, sdf = (tensor.to(device) for tensor in draw(step))
            loss = clamped_l1(decoder(points, codes), sdf, self.delta)
            loss = loss + self.lambda_code * codes.square().mean()
            optimizer.zero_grad()
            (loss * len(seeds)).backward()  # means over shapes would shrink each one's gradient
            optimizer.step()
        return codes.detach()
