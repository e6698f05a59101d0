"""The objective of observed shapes: how far their fields are out of bounds, and how unlikely their codes.

Of a shape with N bounded points x_i, its code z and, where the frame is unknown, the similarity T that
carries x_i into the normalised frame:

    mean_i huber(v_i) + weight / L * (|z - mean|^2 by the prior's covariance + |T|^2 by the range's)

v_i is how far the clamped f(T x_i, z) lies outside its bounds [low_i, high_i], which grow with T's scale s,
over s: in the observation's units. In those of the normalised frame it would pay to shrink the observation.
Source: Park et al. 2019, equation 10, whose samples have equal bounds.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from sdfhub.latent.fitting import Poses, Shapes
from sdfhub.latent.gaussian import Gaussian
from sdfhub.latent.similarity import SIZE, small_similarity, turns
from sdfhub.model.decoder import Decoder

ROWS_AT_ONCE = 2**12  # rows differentiated at a time on a CPU, by each thread; bounds memory


class Rows(NamedTuple):
    """Bounded points of B shapes, as in `Observation`."""

    points: Tensor  # [B, N, 3]
    low: Tensor  # [B, N]
    high: Tensor  # [B, N]
    unsigned: Tensor  # [B, N]
    soft: Tensor  # [B] violation below which the objective is a parabola, normalised frame, > 0
    prior: Tensor  # [B] number of the shape's prior in the problem

    @classmethod
    def of(cls, observations: Shapes, smallest: float, prior: Sequence[int], device: torch.device) -> "Rows":
        """B observations of equally many points; `soft` is their noise, at least `smallest`."""
        parts = [np.stack([getattr(shape, name) for shape in observations]) for name in cls._fields[:4]]
        soft = torch.tensor([max(smallest, shape.noise) for shape in observations])
        rows = *map(torch.from_numpy, parts), soft, torch.tensor(prior)
        return cls(*(part.to(device) for part in rows))

    def some(self, shapes: Tensor | slice, every: int = 1) -> "Rows":
        """Every so many-th row of some shapes."""
        parts = [part[shapes][:, ::every] for part in self[:4]]
        return Rows(*parts, *(part[shapes] for part in self[4:]))

    def turned(self, rotations: Tensor) -> "Rows":
        """The same with points under rotations, [3, 3] or [B, 3, 3]."""
        return self._replace(points=self.points @ rotations.mT)


def violation(decoder: Decoder, codes: Tensor, rows: Rows, delta: float) -> Tensor:
    """How far outside its bounds the clamped field of codes [B, L] is, [B, N]; rows of B shapes or one."""
    field = decoder(rows.points.expand(len(codes), -1, -1), codes).clamp(-delta, delta)
    field = torch.where(rows.unsigned, field.abs(), field)
    return (field - rows.high.clamp(-delta, delta)).relu() - (rows.low.clamp(-delta, delta) - field).relu()


class Problem:
    """The objective as a function of unknowns [U]: codes [L] and, with a range of poses, 7 numbers more.

    A pose is one of the range's turns followed by a small similarity. Priors have weights, `Rows.prior` says
    which one a shape has; the decoder is in evaluation mode.
    """

    def __init__(self, decoder: Decoder, priors: list[tuple[Gaussian, float]], delta: float, poses: Poses):
        self.decoder, self.delta, self.has_pose = decoder, delta, poses is not None
        like = priors[0][0].mean
        self.size = len(like)
        self.turns = (turns(poses.turns, poses.up) if poses else torch.eye(3)[None]).to(like)
        precisions = [torch.linalg.inv(codes.covariance) for codes, _ in priors]
        if poses:
            narrow = pad(poses.spread().to(like).pow(-2), (self.size, 0)).diag()
            precisions = [pad(part, (0, SIZE, 0, SIZE)) + narrow for part in precisions]
        weights = [weight / self.size for _, weight in priors]
        self.center = self.unknowns(torch.stack([codes.mean for codes, _ in priors]))  # [P, U]
        self.precision = torch.stack([w * part for w, part in zip(weights, precisions, strict=True)])

    def unknowns(self, codes: Tensor) -> Tensor:
        """Unknowns [..., U] of codes [..., L] in the frame as it is."""
        return pad(codes, (0, SIZE)) if self.has_pose else codes

    def about(self, rows: Rows, turn: Tensor, unknowns: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The objective at unknowns [B, U], its gradient [B, U] and a positive definite Hessian [B, U, U].

        Large violations enter as reweighted squares: |v| ~ v^2 / |v|, 1 / max(|v|, soft) held for a step.

        Source: Holland and Welsch 1977 (reweighting).
        """
        out, jacobian = self._jacobian(rows.turned(self.turns[turn]), unknowns)
        soft, size = rows.soft[:, None], out.abs()
        huber = torch.where(size < soft, size.square() / (2 * soft), size - soft / 2)
        weighted = (jacobian / torch.maximum(size, soft)[..., None] / out.shape[1]).mT
        precision, away = self.precision[rows.prior], unknowns - self.center[rows.prior]
        pull = (precision @ away[..., None]).squeeze(-1)
        gradient = (weighted @ out[..., None]).squeeze(-1) + 2 * pull
        return huber.mean(1) + (pull * away).sum(1), gradient, weighted @ jacobian + 2 * precision

    def violation(self, rows: Rows, unknowns: Tensor) -> Tensor:
        """Violations [B, N] of rows already turned, in the observations' units, by unknowns [B, U]."""
        if not self.has_pose:
            return violation(self.decoder, unknowns, rows, self.delta)
        pose = small_similarity(unknowns[:, self.size :])
        scale = pose.scale[:, None]
        rows = rows._replace(points=pose.moved(rows.points), low=rows.low * scale, high=rows.high * scale)
        return violation(self.decoder, unknowns[:, : self.size], rows, self.delta) / scale

    def _jacobian(self, rows: Rows, unknowns: Tensor) -> tuple[Tensor, Tensor]:
        """Violations [B, N] and their derivatives [B, N, U]: each row has a copy of its shape's unknowns."""
        shapes, count = rows.low.shape
        size = ROWS_AT_ONCE if unknowns.is_cpu else shapes * count
        copies = unknowns.repeat_interleave(count, 0).split(size)
        singles = zip(*(part.flatten(0, 1)[:, None].split(size) for part in rows[:4]), strict=True)
        pairs = []
        for copy, single in zip(copies, singles, strict=True):
            with torch.enable_grad():
                copy = copy.detach().requires_grad_()
                out = self.violation(Rows(*(*single, *rows[4:])), copy)[:, 0]
                pairs.append((out.detach(), *torch.autograd.grad(out.sum(), copy)))
        out, jacobian = (torch.cat(column) for column in zip(*pairs, strict=True))
        return out.reshape(shapes, count), jacobian.unflatten(0, (shapes, count))
