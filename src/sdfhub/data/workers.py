"""Functions mapped over worker processes; a worker that dies costs one item, not the rest.

The processes are loky's: new interpreters, which do not run the caller's main script again.
"""

import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, as_completed
from contextlib import contextmanager, suppress
from itertools import chain
from multiprocessing import resource_tracker
from typing import Any

from loky.process_executor import BrokenProcessPool, ProcessPoolExecutor

# what tells the numeric libraries how many threads to start; read when they are imported
THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "IGL_NUM_THREADS")
SAFE_PATH = "PYTHONSAFEPATH"  # keeps Python from importing modules of the current folder


class Crashed:
    """The result of an item whose worker process died (out of memory, a fault in a native library)."""


def map_in_processes(function: Callable, items: list, workers: int) -> Iterator[tuple[int, Any]]:
    """(index, function(item)) of each item, in the order in which they end; `Crashed` where a worker died.

    Function and items are picklable; exceptions are raised here. A worker has one thread.
    """
    if workers < 2:
        yield from enumerate(map(function, items))
        return
    left = dict(enumerate(items))
    while left:
        try:
            for index, result in _in_pool(function, left, workers):
                del left[index]
                yield index, result
        except BrokenProcessPool:
            # The item that killed its worker was among the first of those left: try these one at a time.
            for index in list(left)[: 2 * workers]:
                try:
                    yield from _in_pool(function, {index: left.pop(index)}, 1)
                except BrokenProcessPool:
                    yield index, Crashed()


def stream_in_processes(function: Callable, items: Iterable, workers: int) -> Iterator[Any]:
    """function(item) of each item, in their order, computed while the caller makes the next items.

    At most two items a worker wait. Where a worker dies, what is left is computed here, as with fewer than
    two workers. Otherwise as `map_in_processes`.
    """
    items, left, futures = iter(items), deque[Any](), deque[Future]()
    if workers >= 2:
        with suppress(BrokenProcessPool), _pool(function, workers) as pool:
            for item in items:
                left.append(item)
                futures.append(pool.submit(_call, item))
                if len(left) > 2 * workers:
                    yield futures.popleft().result()
                    left.popleft()
            while futures:
                yield futures.popleft().result()
                left.popleft()
    yield from map(function, chain(left, items))


def _in_pool(function: Callable, items: dict[int, Any], workers: int) -> Iterator[tuple[int, Any]]:
    with _pool(function, workers) as pool:
        futures = {pool.submit(_call, item): index for index, item in items.items()}
        yield from ((futures[future], future.result()) for future in as_completed(futures))


@contextmanager
def _pool(function: Callable, workers: int) -> Iterator[ProcessPoolExecutor]:
    before = os.environ.pop(SAFE_PATH, None)
    os.environ[SAFE_PATH] = "1"  # for the processes that clean up after the workers; started once
    resource_tracker.ensure_running()
    env, arguments = dict.fromkeys((*THREADS, SAFE_PATH), "1"), (function, os.getpid())
    pool = ProcessPoolExecutor(workers, env=env, initializer=_start, initargs=arguments)
    del os.environ[SAFE_PATH]
    os.environ |= {SAFE_PATH: before} if before is not None else {}
    try:
        yield pool
    finally:
        pool.shutdown(kill_workers=True)


_function: Callable  # of a worker process: handed over once, since a source with its files may be large


def _call(item: Any) -> Any:
    return _function(item)


def _start(function: Callable, parent: int) -> None:
    global _function
    _function = function
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: int) -> None:
    """Ends this process when its parent has been killed: the queue alone would keep it waiting."""
    while os.getppid() == parent:
        time.sleep(0.5)
    os._exit(1)
