"""Functions mapped over worker processes; a worker that dies costs one item, not the rest.

The processes are loky's: new interpreters, which do not run the caller's main script again.
"""

import os
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from itertools import islice
from multiprocessing import resource_tracker
from typing import Any

from loky.process_executor import BrokenProcessPool, ProcessPoolExecutor

# what tells the numeric libraries how many threads to start; read when they are imported
THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "IGL_NUM_THREADS")
SAFE_PATH = "PYTHONSAFEPATH"  # keeps Python from importing modules of the current folder
Numbered = Iterator[tuple[int, Any]]  # items or their results, with the index of the item
Crashed = BrokenProcessPool  # an item's result if its worker died: out of memory, a fault in a native library


def map_in_processes(function: Callable, items: Iterable, workers: int) -> Numbered:
    """(index, function(item)) of each item, in the order in which they end; `Crashed` where a worker died.

    Function and items are picklable; exceptions are raised here. A worker has one thread. Items are taken
    while the workers compute, at most two a worker ahead.
    """
    numbered, waiting = enumerate(items), dict[int, Any]()
    if workers < 2:
        yield from ((index, function(item)) for index, item in numbered)
        return
    while True:
        try:
            yield from _in_pool(function, numbered, waiting, workers)
            return
        except BrokenProcessPool:  # the item that killed its worker is one of those waiting: one at a time
            for index, item in waiting.items():
                try:
                    yield from _in_pool(function, iter([(index, item)]), {}, 1)
                except BrokenProcessPool as error:
                    yield index, error
            waiting = {}


def _in_pool(function: Callable, items: Numbered, waiting: dict[int, Any], workers: int) -> Numbered:
    """Results as `map_in_processes` gives them; `waiting` has the items without a result."""
    futures: dict[Future, int] = {}
    pool = _pool(function, workers)
    try:
        while True:
            for index, item in islice(items, 2 * workers + 1 - len(futures)):
                waiting[index] = item
                futures[pool.submit(_call, item)] = index
            if not futures:
                return
            for future in wait(futures, return_when=FIRST_COMPLETED).done:
                index, result = futures.pop(future), future.result()
                del waiting[index]
                yield index, result
    finally:
        pool.shutdown(kill_workers=True)


def _pool(function: Callable, workers: int) -> ProcessPoolExecutor:
    before = os.environ.pop(SAFE_PATH, None)
    os.environ[SAFE_PATH] = "1"  # for the processes that clean up after the workers; started once
    resource_tracker.ensure_running()
    env, arguments = dict.fromkeys((*THREADS, SAFE_PATH), "1"), (function, os.getpid())
    pool = ProcessPoolExecutor(workers, env=env, initializer=_start, initargs=arguments)
    del os.environ[SAFE_PATH]
    os.environ |= {SAFE_PATH: before} if before is not None else {}
    return pool


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
