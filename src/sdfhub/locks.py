"""Lock files, which keep processes apart; the system releases one however its holder ends."""

import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

log = logging.getLogger(__name__)


@contextmanager
def locked(path: Path, patience: float = -1, waiting: str | None = None) -> Iterator[bool]:
    """Holds a lock file; gives False where another process still holds it after `patience` seconds.

    Args:
        path: made where it is missing, in a folder that is there.
        patience: seconds to try for; -1: for ever.
        waiting: logged where the lock cannot be had at once.
    """
    lock = FileLock(path)
    with suppress(Timeout):
        lock.acquire(timeout=0)
    if not lock.is_locked and patience:
        if waiting:
            log.info(waiting)
        with suppress(Timeout):
            lock.acquire(timeout=patience, poll_interval=0.1)
    try:
        yield lock.is_locked
    finally:
        lock.release()


def is_locked(path: Path) -> bool:
    """Whether another process holds the lock file now."""
    if not path.exists() or not os.access(path, os.W_OK):
        return False
    with locked(path, patience=0) as is_free:
        return not is_free
