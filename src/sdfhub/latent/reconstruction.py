"""Codes, and poses where these are unknown, of shapes that were observed: MAP estimation with restarts."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from sdfhub.latent.fitting import ROWS, AdamFit, frozen
from sdfhub.latent.gauss_newton import Quadratic, descend
from sdfhub.latent.observed import Problem, Rows, rows_of, violation
from sdfhub.latent.prior import Prior
from sdfhub.latent.similarity import PoseRange, Similarity, small_similarity
from sdfhub.model.decoder import Decoder
from sdfhub.model.fast.side_by_side import side_by_side
from sdfhub.shapes import Observation

TOGETHER = 64
"""Training codes compared at a time with what was observed."""

KNOWN = 5e-3
"""Bounds no further apart than this, normalised frame, make a signed sample: their middle."""


class Fitted(NamedTuple):
    """What was found of B observed shapes.

    Args:
        codes: [B, L].
        residuals: [B] mean |violation| over all rows, in the observations' units.
        poses: from the observations' frames to the normalised one; None where that was known.
    """

    codes: Tensor
    residuals: Tensor
    poses: Similarity | None = None


class Method(Protocol):
    """How observed shapes are fitted."""

    def __call__(
        self,
        decoder: Decoder,
        codes: Tensor,
        observations: Sequence[Observation],
        poses: PoseRange | None = None,
    ) -> Fitted:
        """The shapes behind observations, each fitted as if it were alone.

        Args:
            decoder: stays as it is; its mode is restored.
            codes: [S, L] of the training shapes.
            observations: of equally many points.
            poses: where the observations' frames are unknown: how far they may be off; else None.
        """


@dataclass(frozen=True)
class MapFit:
    """Gauss-Newton descent from several starts, on a few rows, and from the best of them on all.

    Starts: the prior's mean, random draws from it, and the training codes nearest to what was observed. With
    an unknown pose: as many turns of it, each with the training code nearest then, the best ones.

    Args:
        prior: of the codes.
        weight: of the prior, >= 0.
        weight_partial: the same for shapes of which only a part was seen, >= 0.
        random: draws from the prior to start from, >= 0.
        nearest: training codes to start from, by their violation on `probes` rows, >= 0.
        probes: rows that training codes, and turns of an unknown pose, are compared on, >= 1.
        refined: best starts that go on to all rows, >= 1.
        thinning: starts see every so many-th row, >= 1.
        steps: most steps of a descent, >= 1.
        tolerance: a descent ends when a step lowers its objective by a smaller share.
        smallest: violation below which it counts squared, normalised frame, > 0; noise raises it.
        blurred: the same while starts descend: a larger one leaves fewer minima to be caught in.
        damping: of the first step, in units of the Hessian's mean diagonal, > 0.
        delta: clamp of distances, normalised frame, > 0: the training's.
        seed: of the random draws.
    """

    prior: Prior
    weight: float
    weight_partial: float
    random: int
    nearest: int
    probes: int
    refined: int
    thinning: int
    steps: int
    tolerance: float
    smallest: float
    blurred: float
    damping: float
    delta: float = 0.1
    seed: int = 0

    def __post_init__(self):
        if min(self.probes, self.refined, self.thinning, self.steps) < 1:
            raise ValueError("probes, refined, thinning and steps must be at least 1")
        if min(self.random, self.nearest, self.weight, self.weight_partial) < 0:
            raise ValueError("random, nearest and weights must not be negative")
        if min(self.smallest, self.blurred, self.delta, self.damping) <= 0:
            raise ValueError("smallest, blurred, delta and damping must be positive")

    @torch.no_grad()
    def __call__(
        self,
        decoder: Decoder,
        codes: Tensor,
        observations: Sequence[Observation],
        poses: PoseRange | None = None,
    ) -> Fitted:
        """As `Method` says."""
        with frozen(decoder):
            problem = Problem(decoder, self.prior(codes), self.delta, poses)
            weights = self.weight, self.weight_partial
            rows = rows_of(observations, self.smallest, weights, codes.device)
            if codes.device.type != "cpu":
                return self._fit(problem, codes, rows)
            # a thread a shape: then no neighbour changes even a rounding
            shapes = [slice(shape, shape + 1) for shape in range(len(observations))]
            found = side_by_side(lambda shape: self._fit(problem, codes, rows.of(shape)), shapes, least=1)
            return joined(found)

    def _fit(self, problem: Problem, codes: Tensor, rows: Rows) -> Fitted:
        shapes = len(rows.soft)
        turn, unknowns = self._starts(problem, codes, rows)  # [B, K], [B, K, U]
        count = turn.shape[1]
        owner = torch.arange(shapes, device=turn.device)[:, None].expand(-1, count).flatten()
        turn, unknowns = turn.flatten(), unknowns.flatten(0, 1)
        damping = torch.full_like(unknowns[:, 0], self.damping)
        blurred = rows._replace(soft=rows.soft.clamp(min=self.blurred))
        unknowns, damping, values = self._descend(
            problem, blurred, owner, turn, unknowns, damping, self.thinning
        )
        best = _least(values, shapes, self.refined)
        owner, turn = owner[best], turn[best]
        unknowns, _, values = self._descend(problem, rows, owner, turn, unknowns[best], damping[best])
        best = _least(values, shapes, 1)
        return _found(problem, rows, turn[best], unknowns[best])

    def _starts(self, problem: Problem, codes: Tensor, rows: Rows) -> tuple[Tensor, Tensor]:
        """Turns [B, K] and unknowns [B, K, U] to descend from."""
        shapes, drawn = len(rows.soft), problem.prior.draw(self.random, self.seed)
        blind = torch.cat([problem.prior.mean[None], drawn]).expand(shapes, -1, -1)
        if len(problem.turns) == 1:
            _, near = self._nearest(problem, codes, rows, self.nearest)
            starts = torch.cat([blind, near], 1)
            turn = torch.zeros(starts.shape[:2], dtype=torch.int64, device=codes.device)
            return turn, problem.unknowns(starts)
        near = [self._nearest(problem, codes, rows.turned(turn), 1) for turn in problem.turns]
        scores, starts = (torch.cat(part, 1) for part in zip(*near, strict=True))  # [B, F], [B, F, L]
        turn = scores.argsort(1)[:, : blind.shape[1] + self.nearest]
        starts = starts.gather(1, turn[..., None].expand(-1, -1, starts.shape[2]))
        return turn, problem.unknowns(starts)

    def _nearest(self, problem: Problem, codes: Tensor, rows: Rows, count: int) -> tuple[Tensor, Tensor]:
        """The least mean violations [B, n] by training codes, and these codes [B, n, L]."""
        every = max(1, rows.points.shape[1] // self.probes)
        scores = []
        for shape in range(len(rows.soft)):
            some = rows.of(slice(shape, shape + 1), every)
            parts = codes.split(TOGETHER)
            found = [violation(problem.decoder, part, some, self.delta).abs().mean(1) for part in parts]
            scores.append(torch.cat(found))
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
        every: int = 1,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """`gauss_newton.descend` from `unknowns` [D, U], under `turn` [D], of shapes `owner` [D]."""
        size = max(1, ROWS * every // rows.points.shape[1])  # descents differentiated at a time

        def about(which: Tensor, at: Tensor) -> Quadratic:
            found = [
                problem.about(rows.of(owner[part], every), turn[part], there)
                for part, there in zip(which.split(size), at.split(size), strict=True)
            ]
            return Quadratic(*(torch.cat(column) for column in zip(*found, strict=True)))

        return descend(about, unknowns, damping, self.steps, self.tolerance)


def _least(values: Tensor, shapes: int, count: int) -> Tensor:
    """Places [shapes * count] of the least `count` of each shape's values, which follow each other."""
    values = values.reshape(shapes, -1)
    best = values.argsort(1)[:, :count]
    return (best + values.shape[1] * torch.arange(shapes, device=values.device)[:, None]).flatten()


def _found(problem: Problem, rows: Rows, turn: Tensor, unknowns: Tensor) -> Fitted:
    codes, residuals, poses = unknowns[:, : problem.size], [], None
    for shape in range(len(unknowns)):
        one = slice(shape, shape + 1)
        left, _ = problem.violation_and_jacobian(rows.of(one), turn[one], unknowns[one])
        residuals.append(left.abs().mean(1))
    if problem.has_pose:
        poses = small_similarity(unknowns[:, problem.size :])
        poses = poses._replace(rotation=poses.rotation @ problem.turns[turn])
    return Fitted(codes, torch.cat(residuals), poses)


def joined(parts: Sequence[Fitted]) -> Fitted:
    """What was found of several groups of shapes, as of one."""
    poses = [part.poses for part in parts if part.poses is not None]
    return Fitted(
        torch.cat([part.codes for part in parts]),
        torch.cat([part.residuals for part in parts]),
        Similarity(*map(torch.cat, zip(*poses, strict=True))) if poses else None,
    )


@dataclass(frozen=True)
class DeepSdfFit:
    """DeepSDF's published recipe, the rival: one start, Adam, and signed samples alone.

    Args:
        adam: the recipe; its own delta does not count.
        delta: clamp of distances, normalised frame, > 0: the training's.
        seed: of the initial code and the draws.
    """

    adam: AdamFit
    delta: float = 0.1
    seed: int = 0

    def __call__(
        self,
        decoder: Decoder,
        codes: Tensor,
        observations: Sequence[Observation],
        poses: PoseRange | None = None,
    ) -> Fitted:
        """As `Method` says.

        Raises:
            ValueError: the frame is unknown, or too few bounds are tight enough to be samples.
        """
        if poses:
            raise ValueError("DeepSDF's recipe finds no poses; use method=map")
        return joined([self._fit(decoder, each, codes.device) for each in observations])

    def _fit(self, decoder: Decoder, observation: Observation, device: torch.device) -> Fitted:
        known = np.flatnonzero((observation.high - observation.low <= KNOWN) & ~observation.unsigned)
        points = torch.from_numpy(observation.points[known])
        sdf = torch.from_numpy((observation.low[known] + observation.high[known]) / 2)
        outside, inside = np.flatnonzero(sdf > 0), np.flatnonzero(sdf < 0)
        if not (len(outside) and len(inside)):
            raise ValueError("DeepSDF's recipe needs signed samples; use method=map")

        def draw(step: int) -> tuple[Tensor, Tensor]:
            rng = np.random.default_rng((self.seed, step))
            half = self.adam.samples // 2
            drawn = rng.choice(outside, self.adam.samples - half), rng.choice(inside, half)
            chosen = np.concatenate(drawn)
            return points[chosen][None], sdf[chosen][None]

        code = replace(self.adam, delta=self.delta)(decoder, draw, [self.seed])
        with frozen(decoder), torch.no_grad():
            rows = rows_of([observation], self.delta, (0.0, 0.0), device)
            return Fitted(code, violation(decoder, code, rows, self.delta).abs().mean(1))
