"""Parts of a computation that need nothing of one another, side by side on the cores of a processor.

PyTorch spreads every operation over its threads, which wait for one another hundreds of times in a training
step. Whole parts, each computed by one thread alone, wait once, at the end.
"""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from functools import cache
from threading import Barrier, Lock
from typing import TypeVar

import torch

Item = TypeVar("Item")
Result = TypeVar("Result")

# threads first call MKL's vector functions in turn: of two at once, one had sines good to a ten-thousandth
_FIRST = Lock()


def side_by_side(work: Callable[[Item], Result], items: Sequence[Item], least: int = 2) -> list[Result]:
    """`work` of every item, in order, on as many threads as PyTorch has here, in the caller's modes.

    Where there is one thread, inside of `work`, or below `least` items it is a plain loop; with 1 a result
    does not depend, not even by rounding, on how many items there are. When the first item to fail raises,
    no thread is at work, and those not begun are left out.
    """
    threads = torch.get_num_threads()
    if threads < 2 or len(items) < least:
        return [work(item) for item in items]
    grads, inference = torch.is_grad_enabled(), torch.is_inference_mode_enabled()
    autocast = torch.get_autocast_dtype("cpu"), torch.is_autocast_enabled("cpu")

    def call(item: Item) -> Result:  # threads do not inherit the modes of the caller
        with torch.inference_mode(inference), torch.set_grad_enabled(grads), torch.autocast("cpu", *autocast):
            return work(item)

    futures = [_pool(threads).submit(call, item) for item in items]
    try:
        wait(futures, return_when=FIRST_EXCEPTION)
    finally:
        for future in futures:
            future.cancel()
        wait(futures)
    failed = [future for future in futures if not future.cancelled() and future.exception()]
    return [future.result() for future in failed or futures]


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    """Threads that each compute alone."""
    started = Barrier(threads + 1, timeout=60)
    pool = ThreadPoolExecutor(threads, "side_by_side", initializer=_compute_alone)
    for _ in range(threads):
        pool.submit(started.wait)  # so that all threads exist before the last line
    started.wait()
    torch.set_num_threads(threads)  # the last call in any thread is what later threads begin with
    return pool


def _compute_alone() -> None:
    torch.get_num_threads()  # a thread's first call takes the number of others, whatever was set before
    torch.set_num_threads(1)
    with _FIRST:
        for function in (torch.sin, torch.cos, torch.exp, torch.tanh):
            function(torch.ones(64))


if hasattr(os, "register_at_fork"):  # not on Windows; a forked process has none of the threads
    os.register_at_fork(after_in_child=_pool.cache_clear)
