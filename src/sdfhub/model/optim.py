"""The optimiser: Adam with a learning rate per group, and schedules over the share of training."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import nn


class Schedule(Protocol):
    """A factor of every learning rate as a function of the share of training done, in [0, 1]."""

    def __call__(self, progress: float) -> float: ...


@dataclass(frozen=True)
class StepDecay:
    """Multiplied by `factor` after each `every` of training (DeepSDF: halved every 500 of 2000 epochs).

    Args:
        every: share of training between two steps, in (0, 1].
        factor: what each step multiplies by, in (0, 1].
    """

    every: float
    factor: float

    def __post_init__(self):
        if not (0 < self.every <= 1 and 0 < self.factor <= 1):
            raise ValueError("every and factor must be in (0, 1]")

    def __call__(self, progress: float) -> float:
        # 1e-9: a progress that rounds to just below a step's edge belongs after it
        return self.factor ** math.floor(progress / self.every + 1e-9)


@dataclass(frozen=True)
class Cosine:
    """Half a cosine from 1 to `final`.

    Args:
        final: factor at the end, in [0, 1].
    """

    final: float = 0.0

    def __post_init__(self):
        if not 0 <= self.final <= 1:
            raise ValueError("final must be in [0, 1]")

    def __call__(self, progress: float) -> float:
        return self.final + (1 - self.final) * 0.5 * (1 + math.cos(math.pi * min(progress, 1.0)))


@dataclass(frozen=True)
class Adam:
    """Adam over the decoder's weights and the codes, each with its own learning rate.

    Args:
        lr_decoder: initial learning rate of the decoder, > 0.
        lr_codes: initial learning rate of the codes, > 0.
        schedule: factor of both over the share of training.
        warmup_steps: over which both first rise from 0; no more than half of training. Counted in steps, not
            as a share: a short training needs it as much as a long one, or its first steps throw the field
            out of [-delta, delta], where the clamped loss has no gradient.
    """

    lr_decoder: float
    lr_codes: float
    schedule: Schedule
    warmup_steps: int = 0

    def __post_init__(self):
        if self.warmup_steps < 0:
            raise ValueError(f"warmup_steps must not be negative, got {self.warmup_steps}")
        if min(self.lr_decoder, self.lr_codes) <= 0:
            raise ValueError(
                f"lr_decoder and lr_codes must be positive, got {self.lr_decoder} and {self.lr_codes}"
            )

    def configure(
        self, decoder: Iterable[nn.Parameter], codes: Iterable[nn.Parameter], steps: int
    ) -> tuple[torch.optim.Optimizer, torch.optim.lr_scheduler.LambdaLR]:
        """The optimiser and its schedule, to be stepped after each of `steps` training steps."""
        groups = [
            {"params": list(decoder), "lr": self.lr_decoder, "name": "decoder"},
            {"params": list(codes), "lr": self.lr_codes, "name": "codes"},
        ]
        optimizer = torch.optim.Adam(groups, fused=True)
        return optimizer, torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: self.factor(step, steps))

    def factor(self, step: int, steps: int) -> float:
        """What multiplies both learning rates at `step`, counted from 0, of `steps`."""
        warmup = min(self.warmup_steps, steps // 2)
        rise = min(1.0, (step + 1) / warmup) if warmup else 1.0
        return rise * self.schedule(step / steps)
