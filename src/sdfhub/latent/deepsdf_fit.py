"""DeepSDF's published recipe for the codes of unseen shapes: one start, Adam, signed samples alone."""

import math
from typing import Annotated

import numpy as np
import torch
from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt
from pydantic.dataclasses import dataclass
from torch import Tensor

from sdfhub.errors import SdfhubError
from sdfhub.latent.fitting import Fitted, frozen
from sdfhub.latent.problem import Rows, violation
from sdfhub.model.losses import clamped_l1
from sdfhub.shapes import Observation

KNOWN = 5e-3  # bounds no further apart than this, normalised frame, make a signed sample: their middle


@dataclass(frozen=True)
class DeepSdfFit:
    """Adam on fresh samples at every step, half of them inside. Source: DeepSDF's published code."""

    steps: PositiveInt = 800
    lr: PositiveFloat = 5e-3
    drop_at: float = 0.5  # share of the steps after which the learning rate is divided by 10
    per_step: Annotated[int, Field(ge=2)] = 8000  # samples a step and shape
    spread: NonNegativeFloat = 0.01  # standard deviation of the initial codes
    lambda_code: NonNegativeFloat = 1e-4  # weight of the prior
    samples: PositiveInt | None = None  # that an observation of a stored shape should hold; None for all
    seed: NonNegativeInt = 0  # of the initial code and the draws

    @torch.enable_grad()
    def __call__(self, decoder, codes, observations, delta, poses=None) -> Fitted:
        """As `Fit` says; refuses an unknown frame, and a side with no bounds tight enough to be samples."""
        if poses:
            raise SdfhubError("fit=deepsdf: finds no poses; use fit=gauss_newton")
        sides = [_signed_sides(observation) for observation in observations]
        generator = torch.Generator().manual_seed(self.seed)
        start = self.spread * torch.randn(codes.shape[1], generator=generator)
        with frozen(decoder):
            fitted = start.repeat(len(sides), 1).to(codes.device).requires_grad_()
            optimizer = torch.optim.Adam([fitted], lr=self.lr)
            for step in range(self.steps):
                if step == math.ceil(self.steps * self.drop_at):
                    optimizer.param_groups[0]["lr"] = self.lr / 10
                drawn = torch.stack([self._drawn(rows, step) for rows in sides]).to(codes.device)
                loss = clamped_l1(decoder(drawn[..., :3], fitted), drawn[..., 3], delta)
                loss = loss + self.lambda_code * fitted.square().mean()
                optimizer.zero_grad()
                (loss * len(sides)).backward()  # the mean over shapes would shrink their gradients
                optimizer.step()
            with torch.no_grad():
                rows = [Rows.of([observation], delta, [0], codes.device) for observation in observations]
                pairs = zip(fitted.split(1), rows, strict=True)
                residuals = [violation(decoder, code, row, delta).abs().mean(1) for code, row in pairs]
        return Fitted(fitted.detach(), torch.cat(residuals))

    def _drawn(self, sides: tuple[Tensor, Tensor], step: int) -> Tensor:
        """A step's samples [per_step, 4] of a shape."""
        rng = np.random.default_rng((self.seed, step))
        counts = self.per_step - self.per_step // 2, self.per_step // 2
        pairs = zip(sides, counts, strict=True)
        return torch.cat([side[rng.integers(len(side), size=count)] for side, count in pairs])


def _signed_sides(observation: Observation) -> tuple[Tensor, Tensor]:
    """Samples [N, 4] outside and inside of an observation, points and distances."""
    known = (observation.high - observation.low <= KNOWN) & ~observation.unsigned
    sdf = (observation.low[known] + observation.high[known]) / 2
    rows = torch.from_numpy(np.column_stack([observation.points[known], sdf]))
    outside, inside = rows[sdf > 0], rows[sdf < 0]
    if not (len(outside) and len(inside)):
        raise SdfhubError("fit=deepsdf: needs signed samples; use fit=gauss_newton")
    return outside, inside
