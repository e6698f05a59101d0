"""Activations in blocks that stay in a processor's cache.

Beside its matrix products a step is some thirty elementwise passes, each as long as the memory makes it.
Worked on in blocks, a chain of passes reads its input once and writes its result once; backward, the chain is
recomputed from that input, so nothing in between is kept. Products may be bfloat16; a block is float32.
"""

from collections.abc import Iterator

import torch
import torch.nn.functional as F
from torch import Tensor

from sdfhub.model.activations import Activation

BLOCK = 2**17
"""Numbers of a block for each thread: a few float32 arrays of it stay in second-level cache."""


def activate(activation: Activation, product: Tensor, shift: Tensor) -> Tensor:
    """a(product + shift), dtype of `product`.

    Args:
        product: [B, N, W].
        shift: [W] or [B, 1, W], added to every point.
    """
    if not _in_blocks(product):
        return activation(product + shift).to(product.dtype)
    return _Blockwise.apply(activation, False, product, shift, *activation.parameters())


def activate_with_slope(activation: Activation, product: Tensor, shift: Tensor) -> tuple[Tensor, Tensor]:
    """a(product + shift) and a'(product + shift); arguments and dtype as for `activate`."""
    if not _in_blocks(product):
        return tuple(part.to(product.dtype) for part in activation.with_slope(product + shift))
    return _Blockwise.apply(activation, True, product, shift, *activation.parameters())


def kept(hidden: Tensor, dropout: float) -> Tensor:
    """Dropout's factors: 0 with probability `dropout`, rounded to 2^-16, else its inverse; like `hidden`.

    On a processor from 16 random bits a number: there PyTorch's own draw takes longer than a layer's product.
    """
    if not _in_blocks(hidden):
        return F.dropout(torch.ones_like(hidden), dropout)
    threshold = round(dropout * 2**16)
    words = torch.empty(-(-hidden.numel() // 4), dtype=torch.int64).random_(-(2**63), None)
    bits = words.view(torch.int16)[: hidden.numel()].view(hidden.shape)
    return (bits >= threshold - 2**15).to(hidden.dtype).mul_(1 / (1 - threshold / 2**16))


def _in_blocks(product: Tensor) -> bool:
    """On a processor; elsewhere, and in a compiled graph, the compiler fuses the passes."""
    return product.is_cpu and not torch.compiler.is_compiling()


def _blocks(product: Tensor) -> Iterator[tuple[slice, slice]]:
    """Ranges of shapes and of points that cover [B, N, W], about BLOCK numbers a thread each."""
    shapes, points, width = product.shape
    block = BLOCK * torch.get_num_threads()
    rows, together = max(1, block // width), max(1, block // max(1, points * width))
    for shape in range(0, shapes, together):
        for row in range(0, points, rows):
            yield slice(shape, shape + together), slice(row, row + rows)


class _Blockwise(torch.autograd.Function):
    """The forward and backward passes of an activation after its shift."""

    @staticmethod
    def forward(ctx, activation: Activation, with_slope: bool, product: Tensor, shift: Tensor, *parameters):
        ctx.activation, ctx.with_slope = activation, with_slope
        ctx.save_for_backward(product, shift, *parameters)
        outputs = tuple(torch.empty_like(product) for _ in range(1 + with_slope))
        for block in _blocks(product):
            x = product[block] + _part(shift, block)
            values = activation.with_slope(x) if with_slope else (activation(x),)
            for output, value in zip(outputs, values, strict=True):
                output[block] = value
        return outputs if with_slope else outputs[0]

    @staticmethod
    def backward(ctx, *cotangents):
        product, shift, *parameters = ctx.saved_tensors
        if torch.is_grad_enabled():  # somebody differentiates this once more: the plain twin can
            x = product + shift
            outputs = ctx.activation.with_slope(x) if ctx.with_slope else (ctx.activation(x),)
            wanted = [tensor for tensor in (product, shift, *parameters) if tensor.requires_grad]
            found = iter(torch.autograd.grad(outputs, wanted, cotangents, create_graph=True))
            return None, None, *(next(found) if t.requires_grad else None for t in ctx.saved_tensors)
        by_product, by_shift = torch.empty_like(product), torch.zeros_like(shift)
        by_parameters = [torch.zeros_like(parameter) for parameter in parameters]
        for block in _blocks(product):
            x = product[block] + _part(shift, block)
            given = [cotangent[block].to(x.dtype) for cotangent in cotangents]
            by_x, by_block = ctx.activation.chain(x, *given)
            by_product[block] = by_x
            part = _part(by_shift, block)
            part += by_x.sum_to_size(part.shape)
            for total, addend in zip(by_parameters, by_block, strict=True):
                total += addend
        return None, None, by_product, by_shift, *by_parameters


def _part(shift: Tensor, block: tuple[slice, slice]) -> Tensor:
    return shift if shift.dim() == 1 else shift[block[0]]
