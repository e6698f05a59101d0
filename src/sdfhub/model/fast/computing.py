"""How a step is computed on the machine at hand: choices of speed and memory, not of what is learned."""

import ctypes
import os
import shutil
from collections.abc import Callable
from importlib.util import find_spec
from typing import Literal

import torch
import torch._functorch.config as aot
from pydantic import PositiveInt
from pydantic.dataclasses import dataclass
from torch import Tensor

from sdfhub.errors import SdfhubError
from sdfhub.model.decoder import Decoder
from sdfhub.model.encodings import Encoding
from sdfhub.model.fast.fused_hash import can_fuse, fused
from sdfhub.model.fast.side_by_side import side_by_side

# samples worked on together: what stays in a core's caches; what fills a GPU and not its memory
TOGETHER = {"cpu": 2**13, "cuda": 2**18}
LEAST = 2**10  # samples that are worth a thread of their own
_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8  # names of options in glibc's malloc.h


@dataclass(frozen=True)
class Computing:
    """Settings that suit a device; None takes what does."""

    points_at_once: PositiveInt | None = None
    """Samples that go through the decoder together, on a CPU in each thread; bounds memory."""
    compile: bool | None = None
    """Whether `torch.compile` fuses the decoder's passes, which needs a C compiler. None: on a GPU, where
    that and Triton are there; what then does not compile runs as it is."""
    tinycudann: bool | None = None
    """Whether tiny-cuda-nn computes a hash encoding; it adds up a table's gradient in any order. None: on a
    GPU, where it is installed and agrees, unless deterministic algorithms are asked for."""
    matmul: Literal["highest", "high", "medium"] | None = None
    """Precision of float32 products. None: `high` (TF32) on a GPU, else `highest`."""

    def threads(self, device: torch.device) -> int:
        """Threads that work on samples of their own: on a CPU all, but what is compiled has one caller."""
        return 1 if device.type != "cpu" or self.compile else torch.get_num_threads()

    def together(self, device: torch.device, samples: int) -> int:
        """Of so many samples, those that are worked on together on this device, in one thread."""
        most = self.points_at_once or TOGETHER.get(device.type, TOGETHER["cuda"])
        return min(most, max(LEAST, -(-samples // self.threads(device))))

    def set_up(self, device: torch.device) -> None:
        """Sets the precision of this process's products, and keeps the memory it frees."""
        torch.set_float32_matmul_precision(self.matmul or ("highest" if device.type == "cpu" else "high"))
        keep_freed_memory()

    def quickest(self, encoding: Encoding, device: torch.device) -> Encoding:
        """The encoding, or its twin by tiny-cuda-nn, refused where it was asked for and none here agrees."""
        is_default, must_repeat = self.tinycudann is None, torch.are_deterministic_algorithms_enabled()
        wanted = not must_repeat if is_default else self.tinycudann
        twin = fused(encoding) if wanted and can_fuse(encoding, device) else encoding
        if self.tinycudann and twin is encoding:
            raise SdfhubError(
                "computing.tinycudann=true: needs encoding=hash with 1, 2, 4 or 8 features a level, a GPU, "
                "and tiny-cuda-nn built for it; null takes it where it is there"
            )
        return twin

    def compiled(self, *functions: Callable, device: torch.device) -> tuple[Callable, ...]:
        """The functions themselves, or what `torch.compile` makes of them on this device.

        What an earlier training of this process compiled is forgotten: there is room for few versions.
        """
        has_compilers = bool(shutil.which(os.environ.get("CC", "cc")) and find_spec("triton"))
        if not (device.type == "cuda" and has_compilers if self.compile is None else self.compile):
            return functions
        import torch._dynamo.config as dynamo  # here: it imports the compiler

        torch.compiler.reset()
        # unless asked for, what does not compile runs as it is; backward is compiled with forward for that
        dynamo.suppress_errors = aot.force_non_lazy_backward_lowering = self.compile is None
        return tuple(torch.compile(function) for function in functions)


def distances(decoder: Decoder, points: Tensor, codes: Tensor) -> Tensor:
    """`decoder(points, codes)` [B, N], in parts: on a CPU side by side, else one after the other."""
    samples = points.shape[0] * points.shape[1]
    count = -(-samples // Computing().together(points.device, samples))
    parts = points.tensor_split(max(1, min(count, points.shape[1])), dim=1)
    in_turn = side_by_side if points.is_cpu else map
    return torch.cat([*in_turn(lambda part: decoder(part, codes), parts)], dim=1)


def keep_freed_memory() -> None:
    """Lets this process keep up to a GiB of what it has freed, for all its threads, where there is glibc.

    Else the layers' outputs go back to the system and are fetched again, zeroed, at every step.
    """
    if set_option := getattr(ctypes.CDLL(None) if os.name == "posix" else None, "mallopt", None):
        for option, value in ((_TRIM_THRESHOLD, 2**30), (_MMAP_THRESHOLD, 2**30), (_ARENA_MAX, 1)):
            set_option(option, value)
