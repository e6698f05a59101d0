"""Codes of shapes that the decoder has not seen: MAP estimation with the decoder frozen.

Two ways to the same minimum, one signature: `AdamFit`, DeepSDF's recipe, and `GaussNewtonFit`. Both find, for
each shape alone, argmin over z of the clamped L1 to its observed distances plus lambda_code * mean z^2.

Source: Park et al. 2019, equation 10.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from sdfhub.latent.gauss_newton import Quadratic, descend, values_and_jacobian
from sdfhub.model.decoder import Decoder
from sdfhub.model.fast.side_by_side import side_by_side
from sdfhub.model.losses import clamped_l1

Draw = Callable[[int], tuple[Tensor, Tensor]]
"""Step number -> points [B, N, 3] and sdf [B, N], the next samples of B shapes."""

ROWS = 2**14
"""Samples that Gauss-Newton looks at together, or one shape's; bounds memory."""


class Fit(Protocol):
    """How codes are found.

    Attributes:
        samples: N, signed samples a draw and shape, half of them inside.
        delta: clamp of distances, normalised frame: the training's.
    """

    @property
    def samples(self) -> int: ...

    @property
    def delta(self) -> float: ...

    def __call__(self, decoder: Decoder, draw: Draw, seeds: Sequence[int]) -> Tensor:
        """Codes [B, L] of B shapes, fitted side by side; each depends on its own shape alone.

        Args:
            decoder: stays as it is; its mode is restored.
            draw: gives the samples.
            seeds: of the B initial codes, one each, so that a code does not depend on its neighbours.
        """


@dataclass(frozen=True)
class AdamFit:
    """Adam on fresh samples at every step.

    Source: DeepSDF's published code: 800 steps, the learning rate divided by 10 halfway, z from
    N(0, 0.01^2), prior 1e-4 * mean z^2.

    Args:
        steps: Adam steps, >= 1.
        lr: initial learning rate, > 0.
        samples: N, signed samples a step and shape, half of them inside.
        spread: standard deviation of the initial codes, >= 0.
        lambda_code: weight of the prior, >= 0.
        drop_at: share of the steps after which the learning rate is divided by 10.
        delta: clamp of distances, normalised frame, > 0: the training's.
    """

    steps: int
    lr: float
    samples: int
    spread: float
    lambda_code: float
    drop_at: float = 0.5
    delta: float = 0.1

    def __post_init__(self):
        if min(self.steps, self.samples) < 1 or min(self.lr, self.delta) <= 0:
            raise ValueError("fit: steps and samples must be at least 1, lr and delta positive")

    @torch.enable_grad()
    def __call__(self, decoder: Decoder, draw: Draw, seeds: Sequence[int]) -> Tensor:
        """Codes [B, L], as `Fit` says."""
        with frozen(decoder):
            codes = initial_codes(decoder, self.spread, seeds).requires_grad_()
            optimizer = torch.optim.Adam([codes], lr=self.lr)
            for step in range(self.steps):
                if step == math.ceil(self.steps * self.drop_at):
                    optimizer.param_groups[0]["lr"] = self.lr / 10
                points, sdf = (tensor.to(codes.device) for tensor in draw(step))
                loss = clamped_l1(decoder(points, codes), sdf, self.delta)
                loss = loss + self.lambda_code * codes.square().mean()
                optimizer.zero_grad()
                (loss * len(seeds)).backward()  # means over shapes would shrink each one's gradient
                optimizer.step()
        return codes.detach()


@dataclass(frozen=True)
class GaussNewtonFit:
    """Damped Gauss-Newton steps on one draw of samples: on a few of them, then on more, then on all.

    A code has some hundred numbers and a shape thousands of residuals, so a step can solve for the code
    instead of following its gradient; some twenty do what Adam needs hundreds for. The absolute value enters
    as a reweighted square: |r| ~ r^2 / |r| with the weight 1 / max(|r|, smallest) held during a step.

    Source: Holland and Welsch 1977 (reweighting).

    Args:
        steps: most steps of a pass, >= 1.
        samples: N, signed samples a shape, half of them inside; drawn once.
        thinning: the first pass sees every so many-th sample, the second every root of it, >= 1.
        tolerance: a pass of a shape ends when a step lowers its objective by a smaller share.
        smallest: residual below which |r| is a parabola, normalised frame, > 0.
        spread: standard deviation of the initial codes, >= 0.
        lambda_code: weight of the prior, >= 0.
        damping: of the first step, in units of the Hessian's mean diagonal, > 0; large ones start slowly.
        delta: clamp of distances, normalised frame, > 0: the training's.
    """

    steps: int
    samples: int
    thinning: int
    tolerance: float
    smallest: float
    spread: float
    lambda_code: float
    damping: float
    delta: float = 0.1

    def __post_init__(self):
        if min(self.steps, self.samples, self.thinning) < 1:
            raise ValueError("fit: steps, samples and thinning must be at least 1")
        if min(self.delta, self.smallest, self.damping) <= 0:
            raise ValueError("fit: delta, smallest and damping must be positive")

    @torch.no_grad()
    def __call__(self, decoder: Decoder, draw: Draw, seeds: Sequence[int]) -> Tensor:
        """Codes [B, L], as `Fit` says."""
        with frozen(decoder):
            start = initial_codes(decoder, self.spread, seeds)
            drawn = (tensor.to(start.device) for tensor in draw(0))
            if start.device.type != "cpu":
                return self._fit(decoder, start, *drawn)
            # a thread a shape: then no neighbour changes even a rounding
            shapes = zip(start.split(1), *(tensor.split(1) for tensor in drawn), strict=True)
            return torch.cat(side_by_side(lambda shape: self._fit(decoder, *shape), list(shapes), least=1))

    def _fit(self, decoder, codes: Tensor, points: Tensor, sdf: Tensor) -> Tensor:
        damping = torch.full_like(codes[:, 0], self.damping)
        for every in sorted({self.thinning, math.isqrt(self.thinning), 1}, reverse=True):

            def about(shapes: Tensor, at: Tensor, some: slice = slice(None, None, every)) -> Quadratic:
                return self._about(decoder, points[shapes, some], sdf[shapes, some], at)

            codes, damping, _ = descend(about, codes, damping, self.steps, self.tolerance)
        return codes

    def _about(self, decoder, points: Tensor, sdf: Tensor, codes: Tensor) -> Quadratic:
        """The objective of samples [B, N] about codes [B, L]."""
        shapes = max(1, ROWS // points.shape[1])
        parts = zip(points.split(shapes), sdf.split(shapes), codes.split(shapes), strict=True)
        found = [self._quadratic(decoder, *part) for part in parts]
        return Quadratic(*(torch.cat(column) for column in zip(*found, strict=True)))

    def _quadratic(self, decoder, points: Tensor, sdf: Tensor, codes: Tensor) -> Quadratic:
        field, jacobian = field_and_jacobian(decoder, points, codes)
        residual = field.clamp(-self.delta, self.delta) - sdf.clamp(-self.delta, self.delta)
        weight = (field.abs() < self.delta) / residual.abs().clamp(min=self.smallest) / points.shape[1]
        weighted = (jacobian * weight[..., None]).mT
        hessian = weighted @ jacobian
        prior = self.lambda_code / codes.shape[1]
        hessian.diagonal(dim1=1, dim2=2).add_(2 * prior)
        return Quadratic(
            value=residual.abs().mean(1) + prior * codes.square().sum(1),
            gradient=(weighted @ residual[..., None]).squeeze(-1) + 2 * prior * codes,
            hessian=hessian,
        )


def field_and_jacobian(decoder: Decoder, points: Tensor, codes: Tensor) -> tuple[Tensor, Tensor]:
    """Signed distances [B, N] and their derivatives by the code [B, N, L].

    Each sample carries a copy of its shape's code.

    Args:
        points: [B, N, 3], normalised frame.
        codes: [B, L].
    """

    def field_of(copies: Tensor, each: Tensor) -> Tensor:
        return decoder(each, copies)[:, 0]

    copies = codes.repeat_interleave(points.shape[1], 0)
    field, jacobian = values_and_jacobian(field_of, copies, points.reshape(-1, 1, 3))
    return field.reshape(points.shape[:2]), jacobian.unflatten(0, points.shape[:2])


def initial_codes(decoder: Decoder, spread: float, seeds: Sequence[int]) -> Tensor:
    """Codes [B, L] from N(0, spread^2), each from its own seed, on the decoder's device."""
    generators = [torch.Generator().manual_seed(seed) for seed in seeds]
    start = torch.stack([torch.randn(decoder.code_size, generator=each) for each in generators])
    return (start * spread).to(next(decoder.parameters()).device)


@contextmanager
def frozen(decoder: Decoder) -> Iterator[None]:
    """The decoder in evaluation mode and without gradients of its weights; restored afterwards."""
    training, learning = decoder.training, [p for p in decoder.parameters() if p.requires_grad]
    decoder.eval()
    for parameter in learning:
        parameter.requires_grad_(False)
    try:
        yield
    finally:
        for parameter in learning:
            parameter.requires_grad_(True)
        decoder.train(training)
