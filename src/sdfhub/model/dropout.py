"""Dropout as a function of a seed, whichever thread draws it."""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import torch
import torch.nn.functional as F
from torch import Tensor

_GENERATOR: ContextVar[torch.Generator | None] = ContextVar("dropout", default=None)


@contextmanager
def drawn_from(seed: int | None) -> Iterator[None]:
    """On the CPU dropout in here, in this thread, is a function of the seed; None: as outside."""
    token = _GENERATOR.set(_GENERATOR.get() if seed is None else torch.Generator().manual_seed(seed))
    try:
        yield
    finally:
        _GENERATOR.reset(token)


def dropout_factors(hidden: Tensor, probability: float) -> Tensor:
    """0 with this probability, else its complement's inverse; like `hidden`."""
    if not hidden.is_cpu or torch.compiler.is_compiling():  # a compiler knows no generators
        return F.dropout(torch.ones_like(hidden), probability)
    drawn = torch.rand(hidden.shape, generator=_GENERATOR.get())  # twice as fast as F.dropout
    return (drawn >= probability).to(hidden.dtype).mul_(1 / (1 - probability))
