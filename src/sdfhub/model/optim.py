"""How fast what is learned: one Adam, a learning rate per group, and schedules over the share of training."""

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
class Constant:
    """The same learning rate from start to end."""

    def __call__(self, progress: float) -> float:
        return 1.0


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
            raise ValueError("schedule: every and factor must be in (0, 1]")

    def __call__(self, progress: float) -> float:
        # 1e-9: a progress that rounds to just below a step's edge belongs after it
        return self.factor ** math.floor(progress / self.every + 1e-9)


@dataclass(frozen=True)
class Cosine:
    """Half a cosine from 1 to `final`, after a linear rise over `warmup`.

    Args:
        warmup: share of training that rises, in [0, 1).
        final: factor at the end, in [0, 1].
    """

    warmup: float = 0.0
    final: float = 0.0

    def __post_init__(self):
        if not (0 <= self.warmup < 1 and 0 <= self.final <= 1):
            raise ValueError("schedule: warmup must be in [0, 1) and final in [0, 1]")

    def __call__(self, progress: float) -> float:
        if progress < self.warmup:
            return progress / self.warmup
        share = (progress - self.warmup) / (1 - self.warmup)
        return self.final + (1 - self.final) * 0.5 * (1 + math.cos(math.pi * min(share, 1.0)))


@dataclass(frozen=True)
class Adam:
    """Adam over the decoder's weights and the codes, each with its own learning rate.

    Args:
        lr_decoder: initial learning rate of the decoder, > 0.
        lr_codes: initial learning rate of the codes, > 0.
        schedule: factor of both over the share of training.
    """

    lr_decoder: float
    lr_codes: float
    schedule: Schedule

    def __post_init__(self):
        if min(self.lr_decoder, self.lr_codes) <= 0:
            raise ValueError("optim: lr_decoder and lr_codes must be positive")

    def configure(
        self, decoder: Iterable[nn.Parameter], codes: Iterable[nn.Parameter], steps: int
    ) -> tuple[torch.optim.Optimizer, torch.optim.lr_scheduler.LambdaLR]:
        """The optimiser and its schedule, to be stepped after each of `steps` training steps."""
        groups = [
            {"params": list(decoder), "lr": self.lr_decoder, "name": "decoder"},
            {"params": list(codes), "lr": self.lr_codes, "name": "codes"},
        ]
        optimizer = torch.optim.Adam(groups, fused=True)
        schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: self.schedule(step / steps))
        return optimizer, schedule
