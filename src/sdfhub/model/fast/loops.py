"""What compiled loops over a layer's numbers share: dtypes, threads, and how numba is set up.

As tensor operations an activation and its gradient are some thirty passes over memory, which cost as much as
the matrix products between them. As loops each direction is one pass, which numba compiles when it is first
used (seconds) and keeps on disk. bfloat16 numbers travel as the upper halves of float32 ones; all arithmetic
is float32.
"""

from collections.abc import Callable
from itertools import pairwise

import numba
import numpy as np
import torch
from llvmlite import binding, ir
from numba.extending import intrinsic, overload
from torch import Tensor

from sdfhub.model.fast.side_by_side import side_by_side

ROWS = 128
"""Points of one shape that are added up together."""

ALONE = 2**17
"""Numbers that one thread works through sooner than it wakes another."""

FAST = {"contract", "nsz", "arcp"}
"""What a compiler may change. Without "nnan" a diverged training shows; "reassoc" would undo careful sums."""

compiled = numba.njit(nogil=True, fastmath=FAST, error_model="numpy", cache=True)
"""Makes a loop of a function. Python's error model would check every division, one number at a time."""

_features = binding.get_host_cpu_features()
if _features.get("avx512f") and not numba.config.CPU_FEATURES:
    _features["prefer-256-bit"] = False  # LLVM shuns the widest registers; matrix products use them anyway
    numba.config.CPU_NAME, numba.config.CPU_FEATURES = binding.get_host_cpu_name(), _features.flatten()


def fits(product: Tensor) -> bool:
    """Whether the loops take it: on the CPU, of one of their dtypes, in no graph that is being compiled."""
    known = product.dtype in (torch.float32, torch.bfloat16)
    return product.is_cpu and known and product.numel() > 0 and not torch.compiler.is_compiling()


def result_dtype(product: Tensor) -> torch.dtype:
    """The dtype of what a loop makes of a product: its own, or autocast's."""
    return torch.get_autocast_dtype("cpu") if torch.is_autocast_enabled("cpu") else product.dtype


def flat(tensor: Tensor) -> np.ndarray:
    """[rows, W] of the same memory."""
    rows = tensor.detach().contiguous().view(-1, tensor.shape[-1])
    return rows.view(torch.uint16).numpy() if rows.dtype == torch.bfloat16 else rows.numpy()


def flat_shift(shift: Tensor, product: Tensor) -> np.ndarray:
    """[B, W] or [1, W] of the numbers of a shift [B, 1, W] or [W] of a product [B, N, W], float32.

    Raises:
        ValueError: it is of other shapes; a loop would read beyond its end.
    """
    rows = flat(shift.float())
    if rows.shape not in ((1, product.shape[2]), (product.shape[0], product.shape[2])):
        raise ValueError(f"a shift {list(shift.shape)} does not fit products {list(product.shape)}")
    return rows


def flat_beside(beside: Tensor | None, product: Tensor) -> np.ndarray | None:
    """[B N, F] of the numbers of [B, N, F], with the dtype of what a loop makes of a product [B, N, W].

    Raises:
        ValueError: it is of other shapes; a loop would read beyond its end.
    """
    if beside is None:
        return None
    if beside.shape[:2] != product.shape[:2]:
        raise ValueError(f"{list(beside.shape)} cannot stand beside products {list(product.shape)}")
    return flat(beside.to(result_dtype(product)))


def chunks(product: Tensor) -> int:
    """How many parts of at most ROWS points of one shape a product [B, N, W] has."""
    return product.shape[0] * -(-product.shape[1] // ROWS)


def over_points(by_shift: Tensor, shift: Tensor) -> Tensor:
    """The gradient by a shift [W] or [B, 1, W], from its parts [chunks, W]."""
    width = shift.shape[-1]
    return by_shift.view(shift.numel() // width, -1, width).sum(1).view(shift.shape)


def run(kernel: Callable, product: Tensor, *arguments) -> None:
    """Runs a loop over the chunks of a product, on as many threads as PyTorch has.

    Args:
        kernel: called with the first chunk and the one after the last, a pair, and the arguments.
        product: [B, N, W].
        arguments: arrays and numbers.
    """
    count, threads = chunks(product), torch.get_num_threads() if product.numel() > ALONE else 1
    ends = [count * part // threads for part in range(threads + 1)]
    side_by_side(lambda some: kernel(some, *arguments), list(pairwise(ends)))


@intrinsic
def _as_float(context, bits):
    signature = numba.float32(numba.uint32)
    return signature, lambda context, builder, sig, args: builder.bitcast(args[0], ir.FloatType())


@intrinsic
def _as_bits(context, number):
    signature = numba.uint32(numba.float32)
    return signature, lambda context, builder, sig, args: builder.bitcast(args[0], ir.IntType(32))


def widened(number):
    """A float32 from a float32 or a bfloat16's bits."""


def narrowed(number, like):
    """A float32 as what `like` is: itself, or the bits of the nearest bfloat16."""


@overload(widened, inline="always")
def _(number):
    if isinstance(number, numba.types.Integer):
        return lambda number: _as_float(np.uint32(number) << np.uint32(16))
    return lambda number: number


@overload(narrowed, inline="always")
def _(number, like):
    if isinstance(like, numba.types.Integer):

        def rounded(number, like):
            bits = _as_bits(number)
            odd = (bits >> np.uint32(16)) & np.uint32(1)
            return np.uint16((bits + np.uint32(0x7FFF) + odd) >> np.uint32(16))

        return rounded
    return lambda number, like: number
