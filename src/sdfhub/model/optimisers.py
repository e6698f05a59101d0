"""The optimiser, with a learning rate for the decoder and one for the codes, and schedules of both."""

import inspect
import math
from collections.abc import Callable, Iterable
from dataclasses import fields
from functools import partial
from typing import Annotated, Any

import torch
from pydantic import Field, NonNegativeInt, PositiveFloat
from pydantic.dataclasses import dataclass
from torch import nn

Schedule = Callable[[float], float]  # from the share of training done to a factor of learning rates


@dataclass(frozen=True)
class StepDecay:
    """Multiplied by `factor`, in (0, 1], after each share `every` of training, in (0, 1].

    Source: DeepSDF halves its rates every 500 of 2000 epochs.
    """

    every: Annotated[float, Field(gt=0, le=1)]
    factor: Annotated[float, Field(gt=0, le=1)]

    def __call__(self, progress: float) -> float:
        # 1e-9: a progress that rounds to just below a step's edge belongs after it
        return self.factor ** math.floor(progress / self.every + 1e-9)


@dataclass(frozen=True)
class Cosine:
    """Half a cosine from 1 to `final`, in [0, 1]."""

    final: Annotated[float, Field(ge=0, le=1)] = 0.0

    def __call__(self, progress: float) -> float:
        return self.final + (1 - self.final) * 0.5 * (1 + math.cos(math.pi * min(progress, 1.0)))


@dataclass(frozen=True)
class Optimisation:
    """An optimiser over the decoder's weights and the codes, each with its own learning rate.

    Without a warm-up the first steps throw the field out of [-delta, delta], where the clamped loss is flat.
    """

    lr_decoder: PositiveFloat = 2e-3
    lr_codes: PositiveFloat = 5e-3
    schedule: Schedule | None = None  # factor of both rates over the share of training
    warmup_steps: NonNegativeInt = 0  # over which both rates rise from 0; at most half of training
    optimizer: Callable[..., torch.optim.Optimizer] = torch.optim.Adam  # or a partial; fused where it can be

    @classmethod
    def of(cls, make: Any) -> "Optimisation":
        """An optimisation itself, or that of a partial of this class or of an optimiser, which may have
        keywords of this class too; its `lr` stands for a rate that is not given."""
        if hasattr(make, "configure"):
            return make
        if make.func is cls:
            return make()
        own = {field.name for field in fields(cls)}
        settings = {name: value for name, value in make.keywords.items() if name in own}
        rest = {name: value for name, value in make.keywords.items() if name not in own}
        rates = {name: rest["lr"] for name in ("lr_decoder", "lr_codes") if "lr" in rest}
        return cls(**rates | settings | {"optimizer": partial(make.func, *make.args, **rest)})

    def configure(
        self,
        decoder: Iterable[nn.Parameter],
        codes: Iterable[nn.Parameter],
        steps: int,
        matrices: Iterable[nn.Parameter] = (),
    ) -> tuple[torch.optim.Optimizer, torch.optim.lr_scheduler.LambdaLR]:
        """The optimiser and its schedule, to be stepped after each of `steps` training steps.

        Those `matrices` of the decoder are a group of their own, at the optimiser's own rate, where its class
        says that it takes them.
        """
        kind = getattr(self.optimizer, "func", self.optimizer)
        apart = list(matrices) if getattr(kind, "takes_matrices", False) else []
        those = set(map(id, apart))
        rest = [weight for weight in decoder if id(weight) not in those]
        rates = (("decoder", rest, self.lr_decoder), ("codes", codes, self.lr_codes))
        groups: list[dict[str, Any]]
        groups = [{"params": list(weights), "lr": rate, "name": name} for name, weights, rate in rates]
        groups += [{"params": apart, "name": "matrices", "matrices": True}] if apart else []
        chosen = getattr(self.optimizer, "keywords", {}).keys() & {"fused", "foreach", "differentiable"}
        can_fuse = "fused" in inspect.signature(self.optimizer).parameters and not chosen
        optimizer = self.optimizer(groups, fused=True) if can_fuse else self.optimizer(groups)
        return optimizer, torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: self.factor(step, steps))

    def factor(self, step: int, steps: int) -> float:
        """What multiplies both learning rates at `step`, counted from 0, of `steps`."""
        warmup = min(self.warmup_steps, steps // 2)
        rise = min(1.0, (step + 1) / warmup) if warmup else 1.0
        return rise * (self.schedule(step / steps) if self.schedule else 1.0)
