"""Dropout that costs less than the layer it follows."""

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


def random_words(count: int) -> Tensor:
    """[count] int64 of random bits, of PyTorch's generator or that of `drawn_from`."""
    return torch.empty(count, dtype=torch.int64).random_(-(2**63), None, generator=_GENERATOR.get())


def kept(hidden: Tensor, dropout: float) -> Tensor:
    """Dropout's factors: 0 with probability `dropout`, rounded to 2^-16, else its inverse; like `hidden`.

    On the CPU from 16 random bits a number: there PyTorch's own draw takes longer than a layer's product.
    """
    if not hidden.is_cpu or torch.compiler.is_compiling():
        return F.dropout(torch.ones_like(hidden), dropout)
    threshold = round(dropout * 2**16)
    bits = random_words(-(-hidden.numel() // 4)).view(torch.int16)[: hidden.numel()].view(hidden.shape)
    return (bits >= threshold - 2**15).to(hidden.dtype).mul_(1 / (1 - threshold / 2**16))
