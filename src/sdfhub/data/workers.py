"""Functions mapped over worker processes; a worker that dies costs one item, not the rest.

The processes are loky's: new interpreters, not forks of a caller that has threads, and they do not run the
caller's main script again, so that it needs no `if __name__ == "__main__"`.
"""

import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, as_completed
from contextlib import contextmanager
from multiprocessing import resource_tracker

from loky.process_executor import BrokenProcessPool, ProcessPoolExecutor

THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "IGL_NUM_THREADS")
"""What tells the numeric libraries how many threads to start; read when they are imported."""

SAFE_PATH = {"PYTHONSAFEPATH": "1"}
"""Keeps Python from importing modules of the current folder."""


class Crashed:
    """The result of an item whose worker process died (out of memory, a fault in a native library)."""


def map_in_processes(function: Callable, items: list, workers: int) -> Iterator[tuple[int, object]]:
    """(index, function(item)) of each item, in the order in which they end.

    Args:
        function: picklable; its exceptions are raised here.
        items: picklable.
        workers: processes, each with one thread.

    Yields:
        Index and result; `Crashed` in place of the result where the worker died on that item.
    """
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


def stream_in_processes(function: Callable, items: Iterable, workers: int) -> Iterator[object]:
    """function(item) of each item, in their order, computed while the caller makes the next items.

    At most two items a worker wait. Where a worker dies, what is left is computed here.

    Args:
        function: picklable; its exceptions are raised here.
        items: picklable; taken one by one.
        workers: processes, as in `map_in_processes`; 0 for none but this one.
    """
    if workers < 1:
        yield from map(function, items)
        return
    waiting: deque[tuple[object, Future | None]] = deque()
    with _pool(function, workers) as pool:
        for item in items:
            waiting.append((item, _submitted(pool, item)))
            if len(waiting) > 2 * workers:
                yield _result(function, *waiting.popleft())
        while waiting:
            yield _result(function, *waiting.popleft())


def workers_worth(items: int, each: int) -> int:
    """Worker processes for so many items where one pays for `each`; 0, for none, where it would be one."""
    workers = min(os.cpu_count() or 1, items // each)
    return workers if workers > 1 else 0


def _in_pool(function: Callable, items: dict[int, object], workers: int) -> Iterator[tuple[int, object]]:
    with _pool(function, workers) as pool:
        futures = {pool.submit(_call, item): index for index, item in items.items()}
        for future in as_completed(futures):
            yield futures[future], future.result()


def _submitted(pool: ProcessPoolExecutor, item: object) -> Future | None:
    try:
        return pool.submit(_call, item)
    except BrokenProcessPool:
        return None


def _result(function: Callable, item: object, future: Future | None) -> object:
    try:
        return function(item) if future is None else future.result()
    except BrokenProcessPool:
        return function(item)


@contextmanager
def _pool(function: Callable, workers: int) -> Iterator[ProcessPoolExecutor]:
    with _safe_path():  # for the processes that clean up after the workers; started once
        resource_tracker.ensure_running()
        pool = ProcessPoolExecutor(
            workers,
            env=dict.fromkeys(THREADS, "1") | SAFE_PATH,
            initializer=_start,
            initargs=(function, os.getpid()),
        )
    try:
        yield pool
    finally:
        pool.shutdown(kill_workers=True)


@contextmanager
def _safe_path() -> Iterator[None]:
    before = {key: os.environ[key] for key in SAFE_PATH if key in os.environ}
    os.environ.update(SAFE_PATH)
    try:
        yield
    finally:
        for key in SAFE_PATH.keys() - before:
            del os.environ[key]
        os.environ.update(before)


_function: Callable | None = None
"""Of a worker process: handed over once, since a source with its list of files may be large."""


def _call(item: object) -> object:
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
