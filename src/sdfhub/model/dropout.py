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
    """On the CPU dropout in here, in this thread, is a function of the seed; None: as outside.

    What is compiled draws from PyTorch's generator, here as elsewhere.
    """
    token = _GENERATOR.set(_GENERATOR.get() if seed is None else torch.Generator().manual_seed(seed))
    try:
        yield
    finally:
        _GENERATOR.reset(token)


def dropout_factors(hidden: Tensor, probability: float) -> Tensor:
    """0 with this probability, rounded to 2^-16 on the CPU, else its complement's inverse; like `hidden`.

    On the CPU a number takes 16 random bits: PyTorch's own draw takes longer there than a layer's product.
    """
    if not hidden.is_cpu or torch.compiler.is_compiling():
        return F.dropout(torch.ones_like(hidden), probability)
    threshold = round(probability * 2**16)
    words = torch.empty(-(-hidden.numel() // 4), dtype=torch.int64)
    bits = words.random_(-(2**63), None, generator=_GENERATOR.get()).view(torch.int16)
    bits = bits[: hidden.numel()].view(hidden.shape)
    return (bits >= threshold - 2**15).to(hidden.dtype).mul_(1 / (1 - threshold / 2**16))
