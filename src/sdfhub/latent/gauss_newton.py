"""Codes of observed shapes, and poses where these are unknown, by Gauss-Newton from several starts."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sdfhub.latent.descent import Quadratic, descend
from sdfhub.latent.fitting import Fitted, fit_groups, frozen
from sdfhub.latent.gaussian import Gaussian
from sdfhub.latent.problem import Prior, Problem, Rows, violation
from sdfhub.latent.similarity import PoseRange, small_similarity
from sdfhub.model.decoder import Decoder
from sdfhub.shapes import Observation

ROWS_TOGETHER = 2**14
"""Rows of descents that are worked on together, or one shape's; bounds memory."""

CODES_TOGETHER = 64
"""Training codes compared at a time with an observation."""

EXACT, WHOLE, PARTIAL = range(3)
"""Priors by what was observed: signed samples, a whole surface, a part of one."""


@dataclass(frozen=True)
class GaussNewtonFit:
    """Damped Gauss-Newton from several starts on a few rows, and from the best of them on more, then on all.

    A code has some hundred numbers and a shape thousands of rows, so a step can solve for the code instead
    of following its gradient; some twenty steps do what Adam needs hundreds for. Starts: the mean of
    the training codes, draws from their distribution, and the training codes nearest to the observation. With
    an unknown pose: as many turns of it, each with the training code nearest then, the best ones.

    Signed samples say where the surface is, and have DeepSDF's prior, N(0, 1) in every direction. What scans
    leave open, the distribution of the training codes decides.

    Args:
        samples: signed samples that an observation of a stored shape should hold, >= 1.
        lambda_code: weight of DeepSDF's prior, mean z^2, for signed samples, >= 0.
        weight: of the distribution of the training codes, for scans, >= 0.
        weight_partial: the same for scans of only a part of the surface, >= 0.
        shrinkage: share of the isotropic covariance in that distribution, 1e-4 to 1: with less, few codes
            leave a covariance that float32 cannot invert.
        random: draws from that distribution to start from, >= 0.
        nearest: training codes to start from, by their violation on `probes` rows, >= 0.
        probes: rows that training codes, and turns of an unknown pose, are compared on, >= 1.
        thinning: starts see every so many-th row, the best of them then every root of it, then all, >= 1.
        steps: most steps of a descent, >= 1.
        tolerance: a descent ends when a step lowers its objective by a smaller share.
        smallest: violation below which it counts squared, normalised frame, > 0; noise raises it.
        blurred: the same while starts descend: a larger one leaves fewer minima to be caught in.
        damping: of the first step, in units of the Hessian's mean diagonal, > 0.
        seed: of the random draws.
    """

    samples: int = 16384
    lambda_code: float = 1e-4
    weight: float = 1e-4
    weight_partial: float = 1e-3
    shrinkage: float = 0.1
    random: int = 2
    nearest: int = 3
    probes: int = 256
    thinning: int = 16
    steps: int = 40
    tolerance: float = 3e-3
    smallest: float = 1e-3
    blurred: float = 1e-2
    damping: float = 10.0
    seed: int = 0

    def __post_init__(self):
        if min(self.samples, self.probes, self.thinning, self.steps) < 1:
            raise ValueError("samples, probes, thinning and steps must be at least 1")
        if min(self.random, self.nearest, self.lambda_code, self.weight, self.weight_partial) < 0:
            raise ValueError("random, nearest, lambda_code and weights must not be negative")
        if min(self.smallest, self.blurred, self.damping) <= 0:
            raise ValueError("smallest, blurred and damping must be positive")
        if not 1e-4 <= self.shrinkage <= 1:
            raise ValueError(f"shrinkage must be in [1e-4, 1], got {self.shrinkage}")

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
                rows = Rows.of(group, self.smallest, [prior_of(each) for each in group], codes.device)
                return self._fit(problem, codes, blind, rows)

            return fit_groups(fit, observations, codes.device)

    def _fit(self, problem: Problem, codes: Tensor, blind: Tensor, rows: Rows) -> Fitted:
        """The fits of B shapes together: all starts on few rows, the best of each shape on more."""
        shapes = len(rows.soft)
        turn, unknowns = self._starts(problem, codes, blind, rows)  # [B, K], [B, K, U]
        owner = torch.arange(shapes, device=turn.device)[:, None].expand_as(turn).flatten()
        turn, unknowns = turn.flatten(), unknowns.flatten(0, 1)
        damping = torch.full_like(unknowns[:, 0], self.damping)
        blurred = rows._replace(soft=rows.soft.clamp(min=self.blurred))
        start = owner, turn, unknowns, damping
        unknowns, damping, values = self._descend(problem, blurred, *start, self.thinning)
        values = values.reshape(shapes, -1)
        best = values.argmin(1) + values.shape[1] * torch.arange(shapes, device=turn.device)
        owner, turn, unknowns, damping = owner[best], turn[best], unknowns[best], damping[best]
        for every in sorted({math.isqrt(self.thinning), 1}, reverse=True):
            unknowns, damping, _ = self._descend(problem, rows, owner, turn, unknowns, damping, every)
        return found(problem, rows, turn, unknowns)

    def _starts(self, problem: Problem, codes: Tensor, blind: Tensor, rows: Rows) -> tuple[Tensor, Tensor]:
        """Turns [B, K] and unknowns [B, K, U] to descend from; `blind` codes are for every shape."""
        shapes = len(rows.soft)
        if not problem.has_pose:
            _, near = self._nearest(problem, codes, rows, self.nearest)
            starts = torch.cat([blind.expand(shapes, -1, -1), near], 1)
            turn = torch.zeros(starts.shape[:2], dtype=torch.int64, device=codes.device)
            return turn, problem.unknowns(starts)
        near = [self._nearest(problem, codes, rows.turned(turn), 1) for turn in problem.turns]
        scores, starts = (torch.cat(part, 1) for part in zip(*near, strict=True))  # [B, F], [B, F, L]
        turn = scores.argsort(1)[:, : len(blind) + self.nearest]
        starts = starts.gather(1, turn[..., None].expand(-1, -1, starts.shape[2]))
        return turn, problem.unknowns(starts)

    def _nearest(self, problem: Problem, codes: Tensor, rows: Rows, count: int) -> tuple[Tensor, Tensor]:
        """The least mean violations [B, n] by training codes, and these codes [B, n, L]."""
        every = max(1, rows.points.shape[1] // self.probes)
        scores = []
        for shape in range(len(rows.soft)):
            some = rows.some(slice(shape, shape + 1), every)
            parts = codes.split(CODES_TOGETHER)
            away = [violation(problem.decoder, part, some, problem.delta).abs().mean(1) for part in parts]
            scores.append(torch.cat(away))
        least, which = torch.stack(scores).topk(min(count, len(codes)), largest=False)
        return least, codes[which]

    def _descend(
        self,
        problem: Problem,
        rows: Rows,
        owner: Tensor,
        turn: Tensor,
        unknowns: Tensor,
        damping: Tensor,
        every: int,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """`descend` from unknowns [D, U] of shapes `owner` [D] under turns [D], on every so many-th row."""
        size = max(1, ROWS_TOGETHER * every // rows.points.shape[1])

        def objective(which: Tensor, at: Tensor) -> Quadratic:
            parts = [
                problem.about(rows.some(owner[part], every), turn[part], there)
                for part, there in zip(which.split(size), at.split(size), strict=True)
            ]
            return Quadratic(*(torch.cat(column) for column in zip(*parts, strict=True)))

        return descend(objective, unknowns, damping, self.steps, self.tolerance)


def prior_of(observation: Observation) -> int:
    """Which prior an observation has: EXACT for signed samples, else WHOLE or PARTIAL."""
    return EXACT if observation.is_exact else PARTIAL if observation.partial else WHOLE


def found(problem: Problem, rows: Rows, turn: Tensor, unknowns: Tensor) -> Fitted:
    """Codes, residuals and poses of B shapes from their turns [B] and unknowns [B, U]."""
    codes, residuals, poses = unknowns[:, : problem.size], [], None
    for shape in range(len(unknowns)):
        row = slice(shape, shape + 1)
        out, _ = problem.violation_and_jacobian(rows.some(row), turn[row], unknowns[row])
        residuals.append(out.abs().mean(1))
    if problem.has_pose:
        poses = small_similarity(unknowns[:, problem.size :])
        poses = poses._replace(rotation=poses.rotation @ problem.turns[turn])
    return Fitted(codes, torch.cat(residuals), poses)
