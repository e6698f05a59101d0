"""The objective of observed shapes: how far their fields are out of bounds, and how unlikely their codes.

Of a shape with N bounded points x_i, its code z and, where the frame is unknown, the similarity T that
carries x_i into the normalised frame:

    mean_i huber(v_i) + weight / L * (|z - mean|^2 by the prior's covariance + |T|^2 by the range's)

v_i is how far the clamped f(T x_i, z) lies outside its bounds [low_i, high_i], which grow with T's scale s,
over s: in the observation's units. In those of the normalised frame it would pay to shrink what was seen.
Source: Park et al. 2019, equation 10, whose samples have equal bounds.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from sdfhub.latent.gauss_newton import Quadratic, values_and_jacobian
from sdfhub.latent.prior import Normal
from sdfhub.latent.similarity import SIZE, PoseRange, small_similarity, turns
from sdfhub.model.decoder import Decoder
from sdfhub.shapes import Observation


class Rows(NamedTuple):
    """Bounded points of B shapes: points [B, N, 3], low, high and unsigned [B, N], soft and weight [B].

    `soft` is the violation below which the objective is a parabola, normalised frame, > 0; `weight` that of
    the prior.
    """

    points: Tensor
    low: Tensor
    high: Tensor
    unsigned: Tensor
    soft: Tensor
    weight: Tensor

    def of(self, shapes: Tensor | slice, every: int = 1) -> "Rows":
        """Every so many-th row of some shapes."""
        return Rows(*(part[shapes][:, ::every] for part in self[:4]), self.soft[shapes], self.weight[shapes])

    def turned(self, rotations: Tensor) -> "Rows":
        """The same with points under rotations, [3, 3] or [B, 3, 3]."""
        return self._replace(points=self.points @ rotations.mT)


def rows_of(
    observations: Sequence[Observation], smallest: float, weights: tuple[float, float], device: torch.device
) -> Rows:
    """Observations of equally many points as tensors.

    Args:
        observations: B of them.
        smallest: least of `soft`, which otherwise is an observation's noise.
        weights: of the prior for wholly and for partly seen shapes.
        device: where to.
    """
    names = ("points", "low", "high", "unsigned")
    parts = [torch.from_numpy(np.stack([getattr(each, name) for each in observations])) for name in names]
    soft = torch.tensor([max(smallest, each.noise) for each in observations])
    weight = torch.tensor([weights[each.partial] for each in observations])
    return Rows(*(part.to(device) for part in (*parts, soft, weight)))


def violation(decoder: Decoder, codes: Tensor, rows: Rows, delta: float) -> Tensor:
    """How far outside its bounds the clamped field is, signed: [B, N].

    Args:
        decoder: in evaluation mode.
        codes: [B, L].
        rows: of B shapes, or of one for all codes.
        delta: clamp of field and bounds.
    """
    field = decoder(rows.points.expand(len(codes), -1, -1), codes).clamp(-delta, delta)
    field = torch.where(rows.unsigned, field.abs(), field)
    return (field - rows.high.clamp(-delta, delta)).relu() - (rows.low.clamp(-delta, delta) - field).relu()


class Problem:
    """The objective as a function of unknowns [U]: codes [L] and, with a range of poses, 7 numbers more.

    A pose is one of the range's turns followed by a small similarity.

    Args:
        decoder: in evaluation mode.
        prior: of the codes.
        delta: clamp of distances.
        poses: None where frames are known.
    """

    def __init__(self, decoder: Decoder, prior: Normal, delta: float, poses: PoseRange | None):
        self.decoder, self.prior, self.delta, self.has_pose = decoder, prior, delta, poses is not None
        self.size = len(prior.mean)
        self.center = self.unknowns(prior.mean)
        self.turns = torch.eye(3).to(prior.mean)[None]
        precision = torch.linalg.inv(prior.covariance)
        if poses:
            self.turns = turns(poses.turns, poses.up).to(prior.mean)
            precision = torch.block_diag(precision, poses.spread().to(precision).pow(-2).diag())
        self.precision = precision / self.size

    def unknowns(self, codes: Tensor) -> Tensor:
        """Unknowns [..., U] of codes [..., L] in the frame as it is."""
        return torch.nn.functional.pad(codes, (0, SIZE)) if self.has_pose else codes

    def about(self, rows: Rows, turn: Tensor, unknowns: Tensor) -> Quadratic:
        """The objective of B shapes about unknowns [B, U].

        Large violations enter as reweighted squares, as in `GaussNewtonFit`.

        Args:
            rows: of the B shapes.
            turn: [B] rows of `turns`.
            unknowns: [B, U].
        """
        found, jacobian = self.violation_and_jacobian(rows, turn, unknowns)
        soft, size = rows.soft[:, None], found.abs()
        huber = torch.where(size < soft, size.square() / (2 * soft), size - soft / 2)
        weighted = (jacobian / torch.maximum(size, soft)[..., None] / found.shape[1]).mT
        away = unknowns - self.center
        pull = away @ self.precision * rows.weight[:, None]
        return Quadratic(
            value=huber.mean(1) + (pull * away).sum(1),
            gradient=(weighted @ found[..., None]).squeeze(-1) + 2 * pull,
            hessian=weighted @ jacobian + 2 * self.precision * rows.weight[:, None, None],
        )

    def violation_and_jacobian(self, rows: Rows, turn: Tensor, unknowns: Tensor) -> tuple[Tensor, Tensor]:
        """Violations [B, N] and their derivatives by the unknowns [B, N, U]; arguments as in `about`.

        Each row carries a copy of its shape's unknowns.
        """
        shapes, count = rows.low.shape
        turned = rows.turned(self.turns[turn])

        def violation_of(copies: Tensor, *each: Tensor) -> Tensor:
            one = Rows(*each, rows.soft, rows.weight)
            if not self.has_pose:
                return violation(self.decoder, copies, one, self.delta)[:, 0]
            pose = small_similarity(copies[:, self.size :])
            scale = pose.scale[:, None]
            one = one._replace(points=pose.moved(one.points), low=one.low * scale, high=one.high * scale)
            return (violation(self.decoder, copies[:, : self.size], one, self.delta) / scale)[:, 0]

        each = (part.flatten(0, 1)[:, None] for part in turned[:4])
        found, jacobian = values_and_jacobian(violation_of, unknowns.repeat_interleave(count, 0), *each)
        return found.reshape(shapes, count), jacobian.unflatten(0, (shapes, count))
