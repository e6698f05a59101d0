"""Similarities x -> scale * rotation x + shift: from an observation's frame to the normalised one."""

import math
from typing import Annotated, Literal, NamedTuple

import torch
from pydantic import Field, PositiveFloat, PositiveInt
from pydantic.dataclasses import dataclass
from torch import Tensor

SIZE = 7  # numbers of a small similarity: log scale, rotation vector [3] in radians, shift [3]
AXES = {"y": 1, "z": 2}


class Similarity(NamedTuple):
    """B similarities."""

    scale: Tensor  # [B], > 0
    rotation: Tensor  # [B, 3, 3], orthogonal, determinant 1
    shift: Tensor  # [B, 3]

    def moved(self, points: Tensor) -> Tensor:
        """Images [B, N, 3] of points [B, N, 3]."""
        return self.scale[:, None, None] * (points @ self.rotation.mT) + self.shift[:, None]


def small_similarity(numbers: Tensor) -> Similarity:
    """The similarities that numbers [B, 7] describe by Rodrigues' formula; zeros are the identity."""
    log_scale, turn, shift = numbers.split([1, 3, 3], dim=-1)
    x, y, z = turn.unbind(-1)
    none = torch.zeros_like(x)
    skew = torch.stack([none, -z, y, z, none, -x, -y, x, none], -1).unflatten(-1, (3, 3))
    angle = (turn.square().sum(-1) + 1e-16).sqrt()[..., None, None]  # the root of 0 has no derivative
    first, second = torch.sinc(angle / math.pi), torch.sinc(angle / (2 * math.pi)).square() / 2
    rotation = torch.eye(3).to(skew) + first * skew + second * (skew @ skew)
    return Similarity(log_scale.exp().squeeze(-1), rotation, shift)


def turns(count: int, up: str) -> Tensor:
    """[count, 3, 3] rotations about the axis `up`, evenly around it; the first is the identity."""
    around = torch.zeros(count, SIZE)
    around[:, 1 + AXES[up]] = torch.arange(count) * (2 * math.pi / count)
    return small_similarity(around).rotation


@dataclass(frozen=True)
class PoseRange:
    """How far an observation's frame may be from the normalised one, and from where the search starts."""

    turns: PositiveInt  # starts about the upright axis, evenly all around it: any turn about it is found
    tilt: PositiveFloat  # of the upright axis, degrees
    scale: Annotated[float, Field(gt=1)]  # largest factor by which sizes may be wrong, either way
    shift: PositiveFloat  # of the centre along an axis, normalised frame
    up: Literal["y", "z"] = "z"

    def spread(self) -> Tensor:
        """[7] standard deviations of a small similarity: half the range, or half a step between turns."""
        spread = torch.full((SIZE,), self.shift / 2)
        spread[0] = math.log(self.scale) / 2
        spread[1:4] = math.radians(self.tilt) / 2
        spread[1 + AXES[self.up]] = math.pi / self.turns
        return spread

    def holds(self, poses: Similarity) -> Tensor:
        """[B] whether similarities lie within the range."""
        tilt = poses.rotation[:, AXES[self.up], AXES[self.up]].clamp(-1, 1).acos()
        is_near = (poses.shift.abs() <= self.shift).all(1) & (tilt <= math.radians(self.tilt))
        return is_near & (poses.scale.log().abs() <= math.log(self.scale))
