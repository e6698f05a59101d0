"""Codes of observed shapes, and poses where these are unknown, by Gauss-Newton from several starts."""

import math
from collections.abc import Sequence
from typing import Annotated, NamedTuple

import torch
from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt
from pydantic.dataclasses import dataclass
from torch import Tensor

from sdfhub.latent.descent import Quadratic, descend
from sdfhub.latent.fitting import Fitted, fit_groups, frozen
from sdfhub.latent.gaussian import Gaussian
from sdfhub.latent.problem import Prior, Problem, Rows, violation
from sdfhub.latent.similarity import PoseRange, small_similarity
from sdfhub.model.decoder import Decoder
from sdfhub.shapes import Observation

ROWS_TOGETHER = 2**14  # rows of descents that are worked on together, or one shape's; bounds memory
CODES_TOGETHER = 64  # training codes compared at a time with an observation


class Descents(NamedTuple):
    """D states of descents: shapes [D], their turns [D], unknowns [D, U] and damping [D]."""

    shape: Tensor
    turn: Tensor
    unknowns: Tensor
    damping: Tensor


@dataclass(frozen=True)
class GaussNewtonFit:
    """Damped Gauss-Newton from several starts on a few rows, and from the best of them on more, then on all.

    A step solves for the code instead of following its gradient: some twenty do what Adam needs hundreds for.
    Starts: the mean of the training codes, draws from their distribution, and the training codes nearest to
    the observation. With an unknown pose: as many turns of it, each with the training code nearest then, the
    best ones. Signed samples have DeepSDF's prior, N(0, 1) in every direction; what scans leave open, the
    distribution of the training codes decides.

    Args:
        samples: signed samples that an observation of a stored shape should hold.
        lambda_code: weight of DeepSDF's prior, mean z^2, for signed samples.
        weight: of the distribution of the training codes, for scans.
        weight_partial: the same for scans of only a part of the surface.
        shrinkage: share of the isotropic covariance in that distribution: with less, few codes leave a
            covariance that float32 cannot invert.
        random: draws from that distribution to start from.
        nearest: training codes to start from, by their violation on `probes` rows.
        probes: rows that training codes, and turns of an unknown pose, are compared on.
        thinning: starts see every so many-th row, the best of them then every root of it, then all.
        steps: most steps of a descent.
        tolerance: a descent ends when a step lowers its objective by a smaller share.
        smallest: violation below which it counts squared, normalised frame; noise raises it.
        blurred: the same while starts descend: a larger one leaves fewer minima to be caught in.
        damping: of the first step, in units of the Hessian's mean diagonal.
        seed: of the random draws.
    """

    samples: PositiveInt = 16384
    lambda_code: NonNegativeFloat = 1e-4
    weight: NonNegativeFloat = 1e-4
    weight_partial: NonNegativeFloat = 1e-3
    shrinkage: Annotated[float, Field(ge=1e-4, le=1)] = 0.1
    random: NonNegativeInt = 2
    nearest: NonNegativeInt = 3
    probes: PositiveInt = 256
    thinning: PositiveInt = 16
    steps: PositiveInt = 40
    tolerance: float = 3e-3
    smallest: PositiveFloat = 1e-3
    blurred: PositiveFloat = 1e-2
    damping: PositiveFloat = 10.0
    seed: NonNegativeInt = 0

    @torch.no_grad()
    def __call__(
        self,
        decoder: Decoder,
        codes: Tensor,
        observations: Sequence[Observation],
        delta: float,
        poses: PoseRange | None = None,
    ) -> Fitted:
        """As `Fit` says."""
        likely = Gaussian.of(codes, self.shrinkage)
        priors = [Prior(Gaussian.isotropic(codes[0]), self.lambda_code)]
        priors += [Prior(likely, weight) for weight in (self.weight, self.weight_partial)]
        blind = torch.cat([likely.mean[None], likely.sample(self.random, self.seed)])
        with frozen(decoder):
            problem = Problem(decoder, priors, delta, poses)

            def fit(group: Sequence[Observation]) -> Fitted:
                prior = [0 if shape.is_exact else 1 + shape.partial for shape in group]
                return self._fit(problem, codes, blind, Rows.of(group, self.smallest, prior, codes.device))

            return fit_groups(fit, observations, codes.device)

    def _fit(self, problem: Problem, codes: Tensor, blind: Tensor, rows: Rows) -> Fitted:
        """The fits of B shapes together: all starts on few rows, the best of each shape on more."""
        turn, unknowns = self._starts(problem, codes, blind, rows)  # [B, K], [B, K, U]
        shape = torch.arange(len(turn), device=turn.device)
        damping = torch.full(turn.shape, self.damping).to(unknowns).flatten()
        starts = Descents(
            shape.repeat_interleave(turn.shape[1]), turn.flatten(), unknowns.flatten(0, 1), damping
        )
        blurred = rows._replace(soft=rows.soft.clamp(min=self.blurred))
        ends, values = self._descend(problem, blurred, starts, self.thinning)
        best = values.reshape(turn.shape).argmin(1) + turn.shape[1] * shape
        ends = Descents(*(part[best] for part in ends))
        for every in sorted({math.isqrt(self.thinning), 1}, reverse=True):
            ends, _ = self._descend(problem, rows, ends, every)
        return _fitted(problem, rows, ends)

    def _starts(self, problem: Problem, codes: Tensor, blind: Tensor, rows: Rows) -> tuple[Tensor, Tensor]:
        """Turns [B, K] and unknowns [B, K, U] to descend from; `blind` codes are for every shape."""
        if not problem.has_pose:
            _, near = self._nearest(problem, codes, rows, self.nearest)
            starts = torch.cat([blind.expand(len(near), -1, -1), near], 1)
            turn = torch.zeros(starts.shape[:2], dtype=torch.int64, device=codes.device)
            return turn, problem.unknowns(starts)
        pairs = [self._nearest(problem, codes, rows.turned(turn), 1) for turn in problem.turns]
        scores, starts = (torch.cat(part, 1) for part in zip(*pairs, strict=True))  # [B, F], [B, F, L]
        turn = scores.argsort(1)[:, : len(blind) + self.nearest]
        starts = starts.gather(1, turn[..., None].expand(-1, -1, starts.shape[2]))
        return turn, problem.unknowns(starts)

    def _nearest(self, problem: Problem, codes: Tensor, rows: Rows, count: int) -> tuple[Tensor, Tensor]:
        """The least mean violations [B, n] by training codes, and these codes [B, n, L]."""
        every = max(1, rows.points.shape[1] // self.probes)
        scores = []
        for shape in range(len(rows.soft)):
            probes, parts = rows.some(slice(shape, shape + 1), every), codes.split(CODES_TOGETHER)
            away = [violation(problem.decoder, part, probes, problem.delta).abs().mean(1) for part in parts]
            scores.append(torch.cat(away))
        least, which = torch.stack(scores).topk(min(count, len(codes)), largest=False)
        return least, codes[which]

    def _descend(self, problem: Problem, rows: Rows, starts: Descents, every: int) -> tuple[Descents, Tensor]:
        """Where descents on every so many-th row end, and the objectives [D] there."""
        size = max(1, ROWS_TOGETHER * every // rows.points.shape[1])

        def objective(which: Tensor, at: Tensor) -> Quadratic:
            parts = [
                problem.about(rows.some(starts.shape[part], every), starts.turn[part], there)
                for part, there in zip(which.split(size), at.split(size), strict=True)
            ]
            return Quadratic(*(torch.cat(column) for column in zip(*parts, strict=True)))

        unknowns, damping, values = descend(
            objective, starts.unknowns, starts.damping, self.steps, self.tolerance
        )
        return starts._replace(unknowns=unknowns, damping=damping), values


def _fitted(problem: Problem, rows: Rows, ends: Descents) -> Fitted:
    """Codes, residuals and poses of B shapes from the ends of their descents."""
    residuals, poses = [], None
    for shape in range(len(ends.shape)):
        row = slice(shape, shape + 1)
        out, _ = problem.violation_and_jacobian(rows.some(row), ends.turn[row], ends.unknowns[row])
        residuals.append(out.abs().mean(1))
    if problem.has_pose:
        poses = small_similarity(ends.unknowns[:, problem.size :])
        poses = poses._replace(rotation=poses.rotation @ problem.turns[ends.turn])
    return Fitted(ends.unknowns[:, : problem.size], torch.cat(residuals), poses)
