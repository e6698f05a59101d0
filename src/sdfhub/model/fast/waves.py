"""sin(omega x) and tanh(beta sin(omega x)) in float32 on the CPU: one pass over memory forward, one backward.

As tensor operations they are some thirty passes. numba compiles the loops when they are first used (seconds)
and keeps them on disk. Backward recomputes from the product: nothing else is kept.

Sines are polynomials fitted by least squares at Chebyshev nodes, errors below 1e-6 for angles omega x up to
2e6; beyond 2e7 nothing is bounded. A hyperbolic tangent is a ratio of two polynomials with the least largest
error, and 1 from 9 on: an approximation that kept away from 1 would have slopes where HOSC is flat.
"""

from collections.abc import Callable
from itertools import pairwise
from typing import TypeGuard

import numba
import numpy as np
import torch
from llvmlite import binding
from torch import Tensor

from sdfhub.model.activations import Activation, Hosc, Siren
from sdfhub.model.fast.side_by_side import side_by_side

ROWS = 128  # points of one shape that are added up together: a longer sum of float32 numbers loses digits
ALONE = 2**17  # numbers that one thread works through sooner than it wakes another
FAST = {"contract", "nsz", "arcp"}  # without "nnan" divergence shows; "reassoc" would undo careful sums

_loop = numba.njit(nogil=True, fastmath=FAST, error_model="numpy", cache=True)  # Python's checks divisions
_inlined = numba.njit(inline="always", fastmath=FAST)

_features = binding.get_host_cpu_features()
if _features.get("avx512f") and not numba.config.CPU_FEATURES:  # type: ignore[attr-defined]
    _features["prefer-256-bit"] = False  # LLVM shuns the widest registers; matrix products use them anyway
    numba.config.CPU_NAME = binding.get_host_cpu_name()  # type: ignore[attr-defined]
    numba.config.CPU_FEATURES = _features.flatten()  # type: ignore[attr-defined]

_f = np.float32
_PI, _PI_REST = _f(np.pi), _f(np.pi - np.float64(_f(np.pi)))


def fits(activation: Activation, product: Tensor, shift: Tensor) -> TypeGuard[Siren]:
    """Whether the loops compute a(product + shift): a sine or HOSC, in float32 on the CPU."""
    return (
        type(activation) in (Siren, Hosc)  # a subclass may be another function
        and not torch.compiler.is_compiling()  # first: a comparison of sizes would be a guard of an export
        and product.is_cpu
        and product.dtype == torch.float32
        and product.numel() > 0
        and shift.shape in (product.shape[2:], (product.shape[0], 1, product.shape[2]))
        and not torch.is_autocast_enabled("cpu")
    )


def wave(
    activation: Siren, product: Tensor, shift: Tensor, sloped: bool, beside: Tensor | None
) -> tuple[Tensor, Tensor | None]:
    """[a(product + shift) | beside] and a', as `activated` in decoder.py, where the activation `fits`."""
    inputs = product, shift.float(), getattr(activation, "log_beta", None), beside
    result = _Wave.apply(*inputs, activation.omega, activation.with_slope, sloped)
    return result if sloped else (result, None)


class _Wave(torch.autograd.Function):
    @staticmethod
    def forward(ctx, product, shift, log_beta, beside, omega: float, plain: Callable, sloped: bool):
        ctx.omega, ctx.plain = omega, plain
        ctx.save_for_backward(product, shift, log_beta)
        width = product.shape[2]
        value = product.new_empty(*product.shape[:2], width + (0 if beside is None else beside.shape[2]))
        slope = product.new_empty(product.shape) if sloped else None
        if beside is not None:
            value[..., width:] = beside
        _run(_forward, product, shift, log_beta, omega, _flat(value), _flat(slope))
        return (value, slope) if sloped else value

    @staticmethod
    def backward(ctx, by_value, by_slope=None):
        product, shift, log_beta = ctx.saved_tensors
        width = product.shape[2]
        by_beside = by_value[..., width:] if ctx.needs_input_grad[3] else None
        if torch.is_grad_enabled():  # the gradient is to be differentiated again
            return *_differentiable(ctx, by_value[..., :width], by_slope), by_beside, None, None, None
        by_product = torch.empty_like(product, memory_format=torch.contiguous_format)
        by_shift, by_log_beta = torch.empty(2, _chunks(product), width)
        arrays = map(_flat, (by_value, by_slope, by_product, by_shift, by_log_beta))
        _run(_backward, product, shift, log_beta, ctx.omega, *arrays)
        by_shift = by_shift.view(shift.numel() // width, -1, width).sum(1).view(shift.shape)
        by_beta = None if log_beta is None else by_log_beta.sum()
        return by_product, by_shift, by_beta, by_beside, None, None, None


def _differentiable(ctx, *cotangents: Tensor | None) -> list[Tensor | None]:
    """The gradients of product, shift and log beta through the plain formula."""
    product, shift, _ = ctx.saved_tensors
    pairs = zip(ctx.plain(product + shift), cotangents, strict=True)
    outputs, given = zip(*(pair for pair in pairs if pair[1] is not None), strict=True)
    needed = ctx.needs_input_grad[:3]
    inputs = [tensor for tensor, need in zip(ctx.saved_tensors, needed, strict=True) if need]
    gradients = iter(torch.autograd.grad(outputs, inputs, given, create_graph=True))
    return [next(gradients) if need else None for need in needed]


def _flat(tensor: Tensor | None) -> np.ndarray | None:
    """[rows, W] of the same memory."""
    return None if tensor is None else tensor.detach().contiguous().view(-1, tensor.shape[-1]).numpy()


def _chunks(product: Tensor) -> int:
    """How many parts of at most ROWS points of one shape a product [B, N, W] has."""
    return product.shape[0] * -(-product.shape[1] // ROWS)


def _run(kernel: Callable, product: Tensor, shift: Tensor, log_beta: Tensor | None, omega, *arrays) -> None:
    """Runs a loop over the chunks of a product, on as many threads as PyTorch has."""
    beta = None if log_beta is None else _f(log_beta.exp().item())
    given = _flat(product), _flat(shift), product.shape[1], _f(omega), beta
    count, threads = _chunks(product), torch.get_num_threads() if product.numel() > ALONE else 1
    ends = [count * part // threads for part in range(threads + 1)]
    side_by_side(lambda chunks: kernel(*chunks, *given, *arrays), list(pairwise(ends)))


@_inlined
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


@_inlined
def _tanh(x):
    x = min(max(x, _f(-9)), _f(9))
    s = x * x
    over = _f(0.0034676355) + s * (_f(2.0156067e-05) + s * _f(1.27440565e-08))
    under = _f(0.025770275) + s * (_f(0.00032402007) + s * _f(7.5227825e-07))
    over = _f(1) + s * (_f(0.13357376) + s * over)
    return x * over / (_f(1) + s * (_f(0.4669068) + s * under))


@_inlined
def _rows(chunk, points):
    """The shape of a chunk, and its first row and the one after its last."""
    per_shape = -(-points // ROWS)
    shape, part = chunk // per_shape, chunk % per_shape
    return shape, shape * points + part * ROWS, shape * points + min(points, (part + 1) * ROWS)


@_loop
def _forward(first, end, product, shift, points, omega, beta, value, slope):
    for chunk in range(first, end):
        shape, low, high = _rows(chunk, points)
        line = shape if len(shift) > 1 else 0
        for p in range(low, high):
            for j in range(product.shape[1]):
                sine, cosine = _sin_cos(omega * (product[p, j] + shift[line, j]))
                a, d = sine, omega * cosine
                if beta is not None:
                    a = _tanh(beta * sine)
                    d = beta * d * (_f(1) - a * a)
                value[p, j] = a
                if slope is not None:
                    slope[p, j] = d


@_loop
def _backward(
    first, end, product, shift, points, omega, beta, by_value, by_slope, by_product, by_shift, by_log_beta
):
    # With u = beta sin(omega x), v = u', a = tanh(u) and d = 1 - a^2:
    # a' = d v, a'' = -d (omega^2 u + 2 a v^2); by log beta, a grows as d u and a' as d (v - 2 a v u).
    for chunk in range(first, end):
        shape, low, high = _rows(chunk, points)
        line = shape if len(shift) > 1 else 0
        by_shift[chunk], by_log_beta[chunk] = 0, 0
        for p in range(low, high):
            for j in range(product.shape[1]):
                u, cosine = _sin_cos(omega * (product[p, j] + shift[line, j]))
                v = omega * cosine
                g = by_value[p, j]
                if beta is None:
                    by_x = g * v
                    if by_slope is not None:
                        by_x -= by_slope[p, j] * omega * omega * u
                else:
                    u, v = beta * u, beta * v
                    a = _tanh(u)
                    d = _f(1) - a * a
                    by_x = d * g * v
                    by_log_beta[chunk, j] += d * g * u
                    if by_slope is not None:
                        by_v, bent = d * by_slope[p, j], _f(2) * a * v
                        by_x -= by_v * (bent * v + omega * omega * u)
                        by_log_beta[chunk, j] += by_v * (v - bent * u)
                by_product[p, j] = by_x
                by_shift[chunk, j] += by_x
