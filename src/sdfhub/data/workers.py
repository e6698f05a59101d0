"""Functions mapped over worker processes; a worker that dies costs one item, not the rest."""

import multiprocessing
import os
import pickle
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, MutableMapping
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import connection
from types import ModuleType

THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "IGL_NUM_THREADS")
"""What tells the numeric libraries how many threads to start; read when they are imported."""


class Crashed:
    """The result of an item whose worker process died (out of memory, a fault in a native library)."""


def map_in_processes(function: Callable, items: list, workers: int) -> Iterator[tuple[int, object]]:
    """(index, function(item)) of each item, in the order in which they end.

    Args:
        function: picklable; its exceptions are raised here.
        items: picklable.
        workers: processes, each with one thread. They are not forked from the caller, whose threads (a
            trainer's, a notebook's) would make that unsafe.

    Yields:
        Index and result; `Crashed` in place of the result where the worker died on that item.
    """
    left = dict(enumerate(items))
    while left:
        try:
            for index, result in _map_until_crash(function, left, workers):
                del left[index]
                yield index, result
        except BrokenProcessPool:
            # Whichever item killed its worker was among the first of those left: try these one at a time.
            for index in list(left)[: 2 * workers]:
                yield index, _alone(function, left.pop(index))


def stream_in_processes(function: Callable, items: Iterable, workers: int) -> Iterator[object]:
    """function(item) of each item, in their order, worked out while the caller makes the next items.

    At most two items a worker wait. Where a worker dies, what is left is worked out here.

    Args:
        function: picklable; its exceptions are raised here.
        items: picklable; taken one by one.
        workers: processes, as in `map_in_processes`; 0 for none but this one.
    """
    if workers < 1:
        yield from map(function, items)
        return
    waiting: deque[tuple[object, Future | None]] = deque()
    pool = _pool(workers, function)
    try:
        for item in items:
            waiting.append((item, _submitted(pool, function, item)))
            if len(waiting) > 2 * workers:
                yield _result(function, *waiting.popleft())
        while waiting:
            yield _result(function, *waiting.popleft())
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def workers_worth(items: int, each: int) -> int:
    """Worker processes for so many items where one pays for `each`; 0, for none, where it would be one."""
    workers = min(os.cpu_count() or 1, items // each)
    return workers if workers > 1 else 0


def _submitted(pool: ProcessPoolExecutor, function: Callable, item: object) -> Future | None:
    try:
        with _startable(function):
            return pool.submit(_call, item)
    except BrokenProcessPool:
        return None


def _result(function: Callable, item: object, future: Future | None) -> object:
    try:
        return function(item) if future is None else future.result()
    except BrokenProcessPool:
        return function(item)


def _map_until_crash(function: Callable, items: dict, workers: int) -> Iterator[tuple[int, object]]:
    with _pool(workers, function) as pool:
        try:
            with _startable(function):
                futures = {pool.submit(_call, item): index for index, item in items.items()}
            for future in as_completed(futures):
                yield futures[future], future.result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def _alone(function: Callable, item: object) -> object:
    with _pool(1, function) as pool:
        try:
            with _startable(function):
                future = pool.submit(_call, item)
            return future.result()
        except BrokenProcessPool:
            return Crashed()


def _pool(workers: int, function: Callable) -> ProcessPoolExecutor:
    methods = multiprocessing.get_all_start_methods()
    context = multiprocessing.get_context("forkserver" if "forkserver" in methods else "spawn")
    if multiprocessing.get_start_method(allow_none=True) not in (None, *methods):
        # a worker of joblib's starts processes in a way of its own, which ours would be told to take up
        multiprocessing.set_start_method(context.get_start_method(), force=True)
    if context.get_start_method() == "forkserver":  # imports once what each worker would import
        context.set_forkserver_preload([function.__module__])
    return ProcessPoolExecutor(workers, mp_context=context, initializer=_start, initargs=(function,))


_function: Callable | None = None
"""Of a worker process: handed over once, since a source with its list of files may be large."""


def _call(item: object) -> object:
    return _function(item)


def _start(function: Callable) -> None:
    """Sets a worker up, and ends it when its parent is killed: the queue alone would keep it waiting."""
    global _function
    _function = function
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    parent = multiprocessing.parent_process()
    threading.Thread(target=lambda: (connection.wait([parent.sentinel]), os._exit(1)), daemon=True).start()


@contextmanager
def _startable(function: Callable) -> Iterator[None]:
    """Lets workers start single-threaded and, unless the function needs it, without the main script.

    Python runs the main script again in every worker: seconds of imports for a trainer, and no start at
    all for a script without an `if __name__ == "__main__"`.
    """
    needs_main = b"__main__" in pickle.dumps(function)
    main = sys.modules["__main__"] if needs_main else ModuleType("__main__")
    with _lent(os.environ, dict.fromkeys(THREADS, "1")), _lent(sys.modules, {"__main__": main}):
        yield


@contextmanager
def _lent(mapping: MutableMapping, entries: dict) -> Iterator[None]:
    """Entries for a while. Others stay as they are: threads may import modules or set variables meanwhile."""
    before = {key: mapping[key] for key in entries if key in mapping}
    mapping.update(entries)
    try:
        yield
    finally:
        for key in entries:
            if key in before:
                mapping[key] = before[key]
            else:
                mapping.pop(key, None)
