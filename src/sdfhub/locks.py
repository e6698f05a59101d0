"""Lock files, which keep processes apart; the system releases one however its holder ends."""

import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

log = logging.getLogger(__name__)


@contextmanager
def locked(path: Path, patience: float = float("inf"), waiting: str | None = None) -> Iterator[bool]:
    """Holds a lock file; gives False where another process still holds it after `patience` seconds.

    Args:
        path: made where it is missing, in a folder that is there.
        patience: seconds to try for.
        waiting: logged once where the lock cannot be had at once.
    """
    lock = FileLock(path)
    is_held = _acquired(lock, 0)
    if not is_held and patience > 0:
        if waiting:
            log.info(waiting)
        is_held = _acquired(lock, -1 if patience == float("inf") else patience)
    try:
        yield is_held
    finally:
        if is_held:
            lock.release()


def _acquired(lock: FileLock, timeout: float) -> bool:
    try:
        lock.acquire(timeout=timeout, poll_interval=0.1)
    except Timeout:
        return False
    return True


def is_locked(path: Path) -> bool:
    """Whether another process holds the lock file now."""
    if not path.exists() or not os.access(path, os.W_OK):
        return False
    with locked(path, patience=0) as is_free:
        return not is_free
