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

from sdfhub.latent.descent import Quadratic, values_and_jacobian
from sdfhub.latent.gaussian import Gaussian
from sdfhub.latent.similarity import SIZE, PoseRange, small_similarity, turns
from sdfhub.model.decoder import Decoder
from sdfhub.shapes import Observation


class Prior(NamedTuple):
    """A distribution of codes, and the weight that it has in the objective."""

    codes: Gaussian
    weight: float


class Rows(NamedTuple):
    """Bounded points of B shapes: points [B, N, 3], low, high and unsigned [B, N], soft and prior [B].

    `soft` is the violation below which the objective is a parabola, normalised frame, > 0; `prior` the number
    of the shape's prior in the problem.
    """

    points: Tensor
    low: Tensor
    high: Tensor
    unsigned: Tensor
    soft: Tensor
    prior: Tensor

    @classmethod
    def of(
        cls, observations: Sequence[Observation], smallest: float, prior: Sequence[int], device: torch.device
    ) -> "Rows":
        """B observations of equally many points as tensors; `soft` is their noise, at least `smallest`."""
        names = ("points", "low", "high", "unsigned")
        parts = [
            torch.from_numpy(np.stack([getattr(shape, name) for shape in observations])) for name in names
        ]
        soft = torch.tensor([max(smallest, observation.noise) for observation in observations])
        return cls(*(part.to(device) for part in (*parts, soft, torch.tensor(prior))))

    def some(self, shapes: Tensor | slice, every: int = 1) -> "Rows":
        """Every so many-th row of some shapes."""
        parts = [part[shapes][:, ::every] for part in self[:4]]
        return Rows(*parts, *(part[shapes] for part in self[4:]))

    def turned(self, rotations: Tensor) -> "Rows":
        """The same with points under rotations, [3, 3] or [B, 3, 3]."""
        return self._replace(points=self.points @ rotations.mT)


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
        priors: P of them; `Rows.prior` says which one a shape has.
        delta: clamp of distances.
        poses: None where frames are known.
    """

    def __init__(self, decoder: Decoder, priors: Sequence[Prior], delta: float, poses: PoseRange | None):
        self.decoder, self.delta, self.has_pose = decoder, delta, poses is not None
        like = priors[0].codes.mean
        self.size = len(like)
        self.turns = torch.eye(3).to(like)[None]
        precisions = [torch.linalg.inv(prior.codes.covariance) for prior in priors]
        if poses:
            self.turns = turns(poses.turns, poses.up).to(like)
            narrow = torch.nn.functional.pad(poses.spread().to(like).pow(-2), (self.size, 0)).diag()
            around = (0, SIZE, 0, SIZE)
            precisions = [torch.nn.functional.pad(part, around) + narrow for part in precisions]
        weighted = [prior.weight / self.size * part for prior, part in zip(priors, precisions, strict=True)]
        self.center = torch.stack([self.unknowns(prior.codes.mean) for prior in priors])  # [P, U]
        self.precision = torch.stack(weighted)  # [P, U, U]

    def unknowns(self, codes: Tensor) -> Tensor:
        """Unknowns [..., U] of codes [..., L] in the frame as it is."""
        return torch.nn.functional.pad(codes, (0, SIZE)) if self.has_pose else codes

    def about(self, rows: Rows, turn: Tensor, unknowns: Tensor) -> Quadratic:
        """The objective of B shapes about unknowns [B, U].

        The absolute value of large violations enters as a reweighted square: |v| ~ v^2 / |v| with the weight
        1 / max(|v|, soft) held during a step.

        Source: Holland and Welsch 1977 (reweighting).

        Args:
            rows: of the B shapes.
            turn: [B] rows of `turns`.
            unknowns: [B, U].
        """
        out, jacobian = self.violation_and_jacobian(rows, turn, unknowns)
        soft, size = rows.soft[:, None], out.abs()
        huber = torch.where(size < soft, size.square() / (2 * soft), size - soft / 2)
        weighted = (jacobian / torch.maximum(size, soft)[..., None] / out.shape[1]).mT
        precision, away = self.precision[rows.prior], unknowns - self.center[rows.prior]
        pull = (precision @ away[..., None]).squeeze(-1)
        return Quadratic(
            value=huber.mean(1) + (pull * away).sum(1),
            gradient=(weighted @ out[..., None]).squeeze(-1) + 2 * pull,
            hessian=weighted @ jacobian + 2 * precision,
        )

    def violation_and_jacobian(self, rows: Rows, turn: Tensor, unknowns: Tensor) -> tuple[Tensor, Tensor]:
        """Violations [B, N] and their derivatives by the unknowns [B, N, U]; arguments as in `about`.

        Each row carries a copy of its shape's unknowns.
        """
        shapes, count = rows.low.shape

        def violation_of(copies: Tensor, *bounded: Tensor) -> Tensor:
            single = Rows(*[*bounded, *rows[4:]])
            if not self.has_pose:
                return violation(self.decoder, copies, single, self.delta)[:, 0]
            pose = small_similarity(copies[:, self.size :])
            scale = pose.scale[:, None]
            points, low, high = pose.moved(single.points), single.low * scale, single.high * scale
            single = single._replace(points=points, low=low, high=high)
            return (violation(self.decoder, copies[:, : self.size], single, self.delta) / scale)[:, 0]

        inputs = (part.flatten(0, 1)[:, None] for part in rows.turned(self.turns[turn])[:4])
        out, jacobian = values_and_jacobian(violation_of, unknowns.repeat_interleave(count, 0), *inputs)
        return out.reshape(shapes, count), jacobian.unflatten(0, (shapes, count))
