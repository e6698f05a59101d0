"""Codes of observed shapes, and poses where these are unknown, by Gauss-Newton from several starts."""

import math
from collections.abc import Callable
from typing import Annotated, NamedTuple

import torch
from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt
from pydantic.dataclasses import dataclass
from torch import Tensor

from sdfhub.latent.fitting import Fitted, Shapes, frozen
from sdfhub.latent.gaussian import Gaussian
from sdfhub.latent.problem import Problem, Rows, violation
from sdfhub.latent.similarity import Similarity, small_similarity
from sdfhub.model.fast.side_by_side import side_by_side

ROWS_TOGETHER = 2**14  # rows of descents that are worked on together, or one shape's; bounds memory
CODES_TOGETHER = 64  # training codes compared at a time with an observation


class Descents(NamedTuple):
    """States of D descents."""

    shape: Tensor  # [D] number of its shape
    turn: Tensor  # [D] row of the problem's turns
    unknowns: Tensor  # [D, U]
    damping: Tensor  # [D], in units of the Hessians' mean diagonals


@dataclass(frozen=True)
class GaussNewtonFit:
    """Damped Gauss-Newton from several starts on a few rows, and from the best of them on more, then on all.

    Starts: the mean of the training codes, draws from their distribution, and the training codes nearest to
    the observation, or, with an unknown pose, the best of its turns with the training code nearest then.
    Signed samples have DeepSDF's prior, N(0, 1) in every direction, scans the training codes' distribution;
    they say so much that two starts do, the mean and the nearest code.
    """

    samples: PositiveInt = 16384  # signed samples that an observation of a stored shape should hold
    lambda_code: NonNegativeFloat = 1e-4  # weight of DeepSDF's prior, mean z^2, for signed samples
    weight: NonNegativeFloat = 1e-4  # of the distribution of the training codes, for scans
    weight_partial: NonNegativeFloat = 1e-3  # the same for scans of only a part of the surface
    shrinkage: Annotated[float, Field(ge=1e-4, le=1)] = 0.1  # share of isotropic covariance, against singular
    random: NonNegativeInt = 2  # draws from that distribution to start from
    nearest: NonNegativeInt = 3  # training codes to start from, by their violation on `probes` rows
    probes: PositiveInt = 256  # rows that training codes, and turns of an unknown pose, are compared on
    thinning: PositiveInt = 16  # starts see every so many-th row, the best every root of it, then all
    steps: PositiveInt = 40  # at most, of a descent
    tolerance: float = 3e-3  # a descent ends when a step lowers its objective by a smaller share
    smallest: PositiveFloat = 1e-3  # violation below which it counts squared; noise raises it
    blurred: PositiveFloat = 1e-2  # the same while starts descend: a larger one leaves fewer minima
    damping: PositiveFloat = 10.0  # of the first step, in units of the Hessian's mean diagonal
    seed: NonNegativeInt = 0  # of the random draws

    @torch.no_grad()
    def __call__(self, decoder, codes, observations, delta, poses=None) -> Fitted:
        """As `Fit` says."""
        likely = Gaussian.of(codes, self.shrinkage)
        priors = [(Gaussian.isotropic(codes[0]), self.lambda_code)]
        priors += [(likely, weight) for weight in (self.weight, self.weight_partial)]
        blind = torch.cat([likely.mean[None], likely.sample(self.random, self.seed)])
        with frozen(decoder):
            problem = Problem(decoder, priors, delta, poses)

            def fit(group: Shapes) -> list[Tensor]:
                prior = [0 if shape.is_exact else 1 + shape.partial for shape in group]
                rows = Rows.of(group, self.smallest, prior, codes.device)
                starts = (blind, self.nearest) if any(prior) else (blind[:1], min(1, self.nearest))
                return self._fit(problem, codes, *starts, rows)

            fitted, residuals, *pose = in_groups(fit, observations, codes.device)
        return Fitted(fitted, residuals, Similarity(*pose) if pose else None)

    def _fit(self, problem: Problem, codes: Tensor, blind: Tensor, nearest: int, rows: Rows) -> list[Tensor]:
        """Codes, residuals and, where unknown, poses of B shapes: all starts on few rows, the best on all."""
        turn, unknowns = self._starts(problem, codes, blind, nearest, rows)  # [B, K], [B, K, U]
        shape = torch.arange(len(turn), device=turn.device)
        damping = torch.full(turn.shape, self.damping).to(unknowns).flatten()
        starts = shape.repeat_interleave(turn.shape[1]), turn.flatten(), unknowns.flatten(0, 1), damping
        blurred = rows._replace(soft=rows.soft.clamp(min=self.blurred))
        ends, values = self._descend(problem, blurred, Descents(*starts), self.thinning)
        best = values.reshape(turn.shape).argmin(1) + turn.shape[1] * shape
        ends = Descents(*(part[best] for part in ends))
        for every in sorted({math.isqrt(self.thinning), 1}, reverse=True):
            ends, _ = self._descend(problem, rows, ends, every)
        turned, unknowns = rows.turned(problem.turns[ends.turn]), ends.unknowns
        one_by_one = zip(map(turned.some, shape.split(1)), unknowns.split(1), strict=True)
        residuals = torch.cat([problem.violation(*pair).abs().mean(1) for pair in one_by_one])
        pose = small_similarity(unknowns[:, problem.size :]) if problem.has_pose else ()
        if pose:
            pose = pose._replace(rotation=pose.rotation @ problem.turns[ends.turn])
        return [unknowns[:, : problem.size], residuals, *pose]

    def _starts(
        self, problem: Problem, codes: Tensor, blind: Tensor, nearest: int, rows: Rows
    ) -> tuple[Tensor, Tensor]:
        """Turns [B, K] and unknowns [B, K, U] to descend from; `blind` codes are for every shape."""
        if not problem.has_pose:
            _, near = self._nearest(problem, codes, rows, nearest)
            starts = torch.cat([blind.expand(len(near), -1, -1), near], 1)
            turn = torch.zeros(starts.shape[:2], dtype=torch.int64, device=codes.device)
            return turn, problem.unknowns(starts)
        pairs = [self._nearest(problem, codes, rows.turned(turn), 1) for turn in problem.turns]
        scores, starts = (torch.cat(part, 1) for part in zip(*pairs, strict=True))  # [B, F], [B, F, L]
        turn = scores.argsort(1)[:, : len(blind) + nearest]
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
        """Ends of descents on every so many-th row, objectives [D] there (Levenberg 1944, Marquardt 1963)."""
        size = max(1, ROWS_TOGETHER * every // rows.points.shape[1])
        shape, turn, unknowns, damping = (part.clone() for part in starts)

        def about(which: Tensor, at: Tensor) -> list[Tensor]:
            parts = zip(which.split(size), at.split(size), strict=True)
            about = [problem.about(rows.some(shape[part], every), turn[part], there) for part, there in parts]
            return [torch.cat(column) for column in zip(*about, strict=True)]

        left = torch.arange(len(shape), device=shape.device)  # descents that are not done
        here = about(left, unknowns)
        for _ in range(self.steps):
            value, gradient, hessian = (part[left] for part in here)
            mean = hessian.diagonal(dim1=1, dim2=2).mean(1)
            damped = hessian + torch.diag_embed((damping[left] * mean)[:, None].expand_as(gradient))
            # unlike solve, solve_ex lets what is no number pass
            trial = unknowns[left] - torch.linalg.solve_ex(damped, gradient).result
            there = about(left, trial)
            gain = value - there[0]
            lower = gain > 0  # false where there is no number
            damping[left] = torch.where(lower, damping[left] * 0.3, damping[left] * 4).clamp(1e-5, 1e6)
            better = left[lower]
            for old, new in zip((unknowns, *here), (trial, *there), strict=True):
                old[better] = new[lower]
            left = left[~(lower & (gain < self.tolerance * value))]
            if not len(left):
                break
        return Descents(shape, turn, unknowns, damping), here[0]


def in_groups(fit: Callable[[Shapes], list[Tensor]], shapes: Shapes, device: torch.device) -> list[Tensor]:
    """What a fit finds: on a CPU one by one, so that no neighbour changes a rounding, else by size."""
    groups: dict[int, list[int]] = {}
    for row, shape in enumerate(shapes):
        groups.setdefault(row if device.type == "cpu" else len(shape.points), []).append(row)
    work = [[shapes[row] for row in rows] for rows in groups.values()]
    parts = side_by_side(fit, work, least=1) if device.type == "cpu" else map(fit, work)
    order = torch.tensor([row for rows in groups.values() for row in rows]).argsort()
    return [torch.cat(column)[order] for column in zip(*parts, strict=True)]
