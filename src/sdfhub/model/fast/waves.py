"""sin(omega x) and tanh(beta sin(omega x)) on the CPU: one pass over memory forward, one backward.

Backward recomputes from the product: nothing else is kept. Sines are polynomials fitted by least squares at
Chebyshev nodes, errors below 1e-6 for angles omega x up to 2e6; beyond 2e7, where float32 numbers lie a
radian and more apart, sines and the slopes of HOSC are not even bounded. A hyperbolic tangent is a ratio of
two, of the least largest error and 1 from 9 on: one that kept away from 1 would have slopes where HOSC is
flat.
"""

from collections.abc import Callable

import numba
import numpy as np
import torch
from torch import Tensor

from sdfhub.model.fast.loops import (
    FAST,
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

_f = np.float32
_PI, _PI_REST = _f(np.pi), _f(np.pi - np.float64(_f(np.pi)))


class Wave(torch.autograd.Function):
    """[a(product + shift) | beside], and a' where asked for: `Wave.apply(product, shift, log_beta, ...)`.

    Args:
        product: [B, N, W], such that `fits`.
        shift: [W] or [B, 1, W] float32.
        log_beta: logarithm of the sharpness, a scalar tensor; None for a plain sine.
        beside: [B, N, F], what the next layer reads too, or None: once here, nobody copies a later.
        omega: frequency factor.
        plain: x -> a(x), a'(x) as tensor operations, for whoever differentiates the gradient once more.
        with_slope: whether a' is returned too.

    Returns:
        [B, N, W + F] with the dtype of `product`, or of autocast, and a' [B, N, W] where asked for.
    """

    @staticmethod
    def forward(ctx, product, shift, log_beta, beside, omega: float, plain: Callable, with_slope: bool):
        ctx.omega, ctx.plain, ctx.with_slope = omega, plain, with_slope
        ctx.save_for_backward(product, shift, log_beta)
        shapes, points, width = product.shape
        both = width + (0 if beside is None else beside.shape[2])
        dtype = result_dtype(product)
        value = product.new_empty(shapes, points, both, dtype=dtype)
        slope = product.new_empty(product.shape, dtype=dtype) if with_slope else None
        to_copy = flat_beside(beside, product)
        results = flat(value), flat(slope) if with_slope else None
        run(_forward, product, *_given(ctx, product, shift, log_beta), to_copy, *results)
        return (value, slope) if with_slope else value

    @staticmethod
    def backward(ctx, by_value, by_slope=None):
        product, shift, log_beta = ctx.saved_tensors
        width = product.shape[2]
        by_beside = by_value[..., width:] if ctx.needs_input_grad[3] else None
        if torch.is_grad_enabled():
            of_wave = _differentiable(ctx, by_value[..., :width], by_slope)
            return *of_wave, by_beside, None, None, None
        by_product = product.new_empty(product.shape)
        by_shift, by_log_beta = torch.empty(2, chunks(product), width)
        cotangents = flat(by_value), None if by_slope is None else flat(by_slope)
        results = flat(by_product), by_shift.numpy(), by_log_beta.numpy()
        run(_backward, product, *_given(ctx, product, shift, log_beta), *cotangents, *results)
        by_log_beta = None if log_beta is None else by_log_beta.sum()
        return by_product, over_points(by_shift, shift), by_log_beta, by_beside, None, None, None


def _given(ctx, product: Tensor, shift: Tensor, log_beta: Tensor | None) -> tuple:
    beta = None if log_beta is None else _f(log_beta.exp().item())
    return flat(product), flat_shift(shift, product), product.shape[1], _f(ctx.omega), beta


def _differentiable(ctx, by_value: Tensor, by_slope: Tensor | None) -> list[Tensor | None]:
    outputs = ctx.plain(ctx.saved_tensors[0] + ctx.saved_tensors[1])
    cotangents = [by_value, by_slope][: 1 + ctx.with_slope]
    outputs = [out.to(by.dtype) for out, by in zip(outputs, cotangents, strict=False)]
    wanted = [tensor is not None and tensor.requires_grad for tensor in ctx.saved_tensors]
    inputs = [tensor for tensor, is_wanted in zip(ctx.saved_tensors, wanted, strict=True) if is_wanted]
    found = iter(torch.autograd.grad(outputs, inputs, cotangents, create_graph=True))
    return [next(found) if is_wanted else None for is_wanted in wanted]


@numba.njit(inline="always", fastmath=FAST)
def _sin_cos(angle):
    half_turns = np.rint(angle * _f(1 / np.pi))
    rest = (angle - half_turns * _PI) - half_turns * _PI_REST  # in [-pi/2, pi/2]
    sign = _f(1) - _f(2) * (half_turns - _f(2) * np.floor(half_turns * _f(0.5)))
    s = rest * rest
    sine = _f(0.008333016) + s * (_f(-0.00019806546) + s * _f(2.5999025e-06))
    sine = rest + rest * s * (_f(-0.16666657) + s * sine)
    cosine = _f(-0.0013888568) + s * (_f(2.476924e-05) + s * _f(-2.6192475e-07))
    cosine = _f(1) + s * (_f(-0.5) + s * (_f(0.041666657) + s * cosine))
    return sine * sign, cosine * sign


@numba.njit(inline="always", fastmath=FAST)
def _tanh(x):
    x = min(max(x, _f(-9)), _f(9))
    s = x * x
    over = _f(0.0034676355) + s * (_f(2.0156067e-05) + s * _f(1.27440565e-08))
    under = _f(0.025770275) + s * (_f(0.00032402007) + s * _f(7.5227825e-07))
    over = _f(1) + s * (_f(0.13357376) + s * over)
    return x * over / (_f(1) + s * (_f(0.4669068) + s * under))


@compiled
def _forward(some, product, shift, points, omega, beta, beside, value, slope):
    per_shape = -(-points // ROWS)
    for chunk in range(some[0], some[1]):
        shape, part = chunk // per_shape, chunk % per_shape
        line = shape if len(shift) > 1 else 0
        for p in range(shape * points + part * ROWS, shape * points + min(points, (part + 1) * ROWS)):
            for j in range(product.shape[1]):
                sine, cosine = _sin_cos(omega * (widened(product[p, j]) + shift[line, j]))
                a, d = sine, omega * cosine
                if beta is not None:
                    a = _tanh(beta * sine)
                    d = beta * d * (_f(1) - a * a)
                value[p, j] = narrowed(a, value[p, j])
                if slope is not None:
                    slope[p, j] = narrowed(d, slope[p, j])
            if beside is not None:
                for j in range(beside.shape[1]):
                    value[p, product.shape[1] + j] = beside[p, j]


@compiled
def _backward(
    some, product, shift, points, omega, beta, by_value, by_slope, by_product, by_shift, by_log_beta
):
    # With u = beta sin(omega x), v = u', a = tanh(u) and d = 1 - a^2:
    # a' = d v, a'' = -d (omega^2 u + 2 a v^2); by log beta, a grows as d u and a' as d (v - 2 a v u).
    per_shape = -(-points // ROWS)
    for chunk in range(some[0], some[1]):
        shape, part = chunk // per_shape, chunk % per_shape
        line = shape if len(shift) > 1 else 0
        by_shift[chunk], by_log_beta[chunk] = 0, 0
        for p in range(shape * points + part * ROWS, shape * points + min(points, (part + 1) * ROWS)):
            for j in range(product.shape[1]):
                u, cosine = _sin_cos(omega * (widened(product[p, j]) + shift[line, j]))
                v = omega * cosine
                g = widened(by_value[p, j])
                if beta is None:
                    by_x = g * v
                    if by_slope is not None:
                        by_x -= widened(by_slope[p, j]) * omega * omega * u
                else:
                    u, v = beta * u, beta * v
                    a = _tanh(u)
                    d = _f(1) - a * a
                    by_x = d * g * v
                    by_log_beta[chunk, j] += d * g * u
                    if by_slope is not None:
                        by_v, bent = d * widened(by_slope[p, j]), _f(2) * a * v
                        by_x -= by_v * (bent * v + omega * omega * u)
                        by_log_beta[chunk, j] += by_v * (v - bent * u)
                by_product[p, j] = narrowed(by_x, by_product[p, j])
                by_shift[chunk, j] += by_x
