"""Dropout as a function of a seed, whichever thread draws it."""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

_BITS: ContextVar[np.random.SFC64 | None] = ContextVar("dropout", default=None)


@contextmanager
def drawn_from(seed: int | None) -> Iterator[None]:
    """On the CPU dropout in here, in this thread, is a function of the seed; None: as outside."""
    token = _BITS.set(_BITS.get() if seed is None else np.random.SFC64(seed))
    try:
        yield
    finally:
        _BITS.reset(token)


def dropout_factors(hidden: Tensor, probability: float) -> Tensor:
    """0 with this probability, rounded to 2^-16, else its complement's inverse; like `hidden`.

    On the CPU from 16 random bits a number: PyTorch's own draw takes several times as long.
    """
    if not hidden.is_cpu or torch.compiler.is_compiling():  # a compiler knows no generators
        return F.dropout(torch.ones_like(hidden), probability)
    source = _BITS.get() or np.random.SFC64(int(torch.randint(2**63 - 1, ())))
    bits = source.random_raw(-(-hidden.numel() // 4)).view(np.uint16)[: hidden.numel()]
    threshold = round(probability * 2**16)
    factors = np.multiply(bits >= threshold, 1 / (1 - threshold / 2**16), dtype=np.float32)
    return torch.from_numpy(factors).view(hidden.shape).to(hidden.dtype)
