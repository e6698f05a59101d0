"""max(0, x) with dropout on the CPU: one pass over memory forward, one backward.

A unit passes gradients exactly where its output is not 0, so backward needs nothing but the output. Which
units are dropped is a hash of their place and of a random number.
"""

import numba
import numpy as np
import torch

from sdfhub.model.fast.dropout import random_words
from sdfhub.model.fast.loops import (
    ROWS,
    chunks,
    compiled,
    flat,
    flat_beside,
    flat_shift,
    narrowed,
    over_points,
    result_dtype,
    run,
    widened,
)

_f, _u = np.float32, np.uint32


class Rectifier(torch.autograd.Function):
    """[max(0, product + shift) | beside], and the slope where asked for: `Rectifier.apply(product, ...)`.

    Args:
        product: [B, N, W], such that `fits`.
        shift: [W] or [B, 1, W] float32.
        beside: [B, N, F], what the next layer reads too, or None.
        dropout: probability in [0, 1) that a unit is 0; others, and their slopes, are divided by 1 - dropout.
        with_slope: whether slopes are returned too; they are constants to whoever differentiates.

    Returns:
        [B, N, W + F] with the dtype of `product`, or of autocast, and slopes [B, N, W] where asked for.
    """

    @staticmethod
    def forward(ctx, product, shift, beside, dropout: float, with_slope: bool):
        shapes, points, width = product.shape
        both = width + (0 if beside is None else beside.shape[2])
        dtype = result_dtype(product)
        value = product.new_empty(shapes, points, both, dtype=dtype)
        slope = product.new_empty(product.shape, dtype=dtype) if with_slope else None
        given = (
            flat(product),
            flat_shift(shift, product),
            points,
            flat_beside(beside, product),
        )
        drops = (_u(round(dropout * 2**32)), _seed()) if dropout else (None, None)
        ctx.factor, ctx.width = 1 / (1 - dropout), width
        results = flat(value), None if slope is None else flat(slope)
        run(_forward, product, *given, *drops, _f(ctx.factor), *results)
        ctx.save_for_backward(product, shift, value)
        if slope is None:
            return value
        ctx.mark_non_differentiable(slope)
        return value, slope

    @staticmethod
    def backward(ctx, by_value, by_slope=None):
        product, shift, value = ctx.saved_tensors
        by_beside = by_value[..., ctx.width :] if ctx.needs_input_grad[2] else None
        if torch.is_grad_enabled():
            slope = (value[..., : ctx.width].detach() > 0) * ctx.factor
            by_product = by_value[..., : ctx.width].to(product.dtype) * slope.to(product.dtype)
            return by_product, by_product.float().sum_to_size(shift.shape), by_beside, None, None
        by_product = product.new_empty(product.shape)
        by_shift = torch.empty(chunks(product), ctx.width)
        given = flat(value), product.shape[1], _f(ctx.factor), flat(by_value)
        run(_backward, product, *given, flat(by_product), by_shift.numpy())
        return by_product, over_points(by_shift, shift), by_beside, None, None


def _seed() -> np.uint32:
    return _u(random_words(1).item() % 2**32)


@numba.njit(inline="always")
def _random(place, seed):
    """32 random bits of a place. Source: Wellons 2018, the integer hash `lowbias32`."""
    x = _u(_u(place) * _u(0x9E3779B9)) ^ seed  # places of two seeds are in different orders
    x = _u(_u(x ^ (x >> _u(16))) * _u(0x7FEB352D))
    x = _u(_u(x ^ (x >> _u(15))) * _u(0x846CA68B))
    return _u(x ^ (x >> _u(16)))


@compiled
def _forward(some, product, shift, points, beside, threshold, seed, factor, value, slope):
    per_shape, width = -(-points // ROWS), product.shape[1]
    for chunk in range(some[0], some[1]):
        shape, part = chunk // per_shape, chunk % per_shape
        line = shape if len(shift) > 1 else 0
        for p in range(shape * points + part * ROWS, shape * points + min(points, (part + 1) * ROWS)):
            for j in range(width):
                x = widened(product[p, j]) + shift[line, j]
                passes = not (x <= _f(0))  # so that what is not a number stays one
                if threshold is not None:
                    passes = passes and _random(p * width + j, seed) >= threshold
                value[p, j] = narrowed(x * factor if passes else _f(0), value[p, j])
                if slope is not None:
                    slope[p, j] = narrowed(factor if passes else _f(0), slope[p, j])
            if beside is not None:
                for j in range(beside.shape[1]):
                    value[p, width + j] = beside[p, j]


@compiled
def _backward(some, value, points, factor, by_value, by_product, by_shift):
    per_shape, width = -(-points // ROWS), by_product.shape[1]
    for chunk in range(some[0], some[1]):
        shape, part = chunk // per_shape, chunk % per_shape
        by_shift[chunk] = 0
        for p in range(shape * points + part * ROWS, shape * points + min(points, (part + 1) * ROWS)):
            for j in range(width):
                passes = not (widened(value[p, j]) <= _f(0))
                by_x = factor * widened(by_value[p, j]) if passes else _f(0)
                by_product[p, j] = narrowed(by_x, by_product[p, j])
                by_shift[chunk, j] += by_x
