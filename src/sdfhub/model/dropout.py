"""Dropout that costs less than the layer it follows."""

import torch
import torch.nn.functional as F
from torch import Tensor


def kept(hidden: Tensor, dropout: float) -> Tensor:
    """Dropout's factors: 0 with probability `dropout`, rounded to 2^-16, else its inverse; like `hidden`.

    On the CPU from 16 random bits a number: there PyTorch's own draw takes longer than a layer's product.
    """
    if not hidden.is_cpu or torch.compiler.is_compiling():
        return F.dropout(torch.ones_like(hidden), dropout)
    threshold = round(dropout * 2**16)
    words = torch.empty(-(-hidden.numel() // 4), dtype=torch.int64).random_(-(2**63), None)
    bits = words.view(torch.int16)[: hidden.numel()].view(hidden.shape)
    return (bits >= threshold - 2**15).to(hidden.dtype).mul_(1 / (1 - threshold / 2**16))
