"""Lock files, which keep processes apart; the system releases one however its holder ends."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

log = logging.getLogger(__name__)


@contextmanager
def locked(path: Path, waiting: str = "") -> Iterator[None]:
    """Holds a lock file, made where it is missing; logs `waiting` where it cannot be had at once."""
    try:
        held = FileLock(path).acquire(timeout=0)
    except Timeout:
        if waiting:
            log.info(waiting)
        held = FileLock(path).acquire(poll_interval=0.1)
    with held:
        yield
