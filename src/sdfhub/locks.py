"""Lock files, which keep processes apart; the system releases one however its holder ends."""

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO


@contextmanager
def locked(
    path: Path, patience: float = float("inf"), shared: bool = False, waiting: str | None = None
) -> Iterator[bool]:
    """Holds a lock file; gives False where another process still holds it after `patience` seconds.

    Where locks do not work (some network disks, Windows), every process gets it.

    Args:
        path: made where it is missing, in a folder that is there.
        patience: seconds to try for.
        shared: lets in others that ask for a share too.
        waiting: printed once where the lock cannot be had at once.
    """
    limit = time.monotonic() + patience
    with path.open("w") as file:
        while not (ours := _lock(file, shared)) and time.monotonic() < limit:
            if waiting:
                print(waiting, flush=True)
                waiting = None
            time.sleep(0.1)
        yield ours


def _lock(file: TextIO, shared: bool) -> bool:
    try:
        import fcntl

        fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except (ImportError, OSError):
        pass
    return True


def is_locked(path: Path) -> bool:
    """Whether another process holds the lock file now, for itself alone."""
    if not path.exists() or not os.access(path, os.W_OK):
        return False
    with locked(path, patience=0, shared=True) as free:  # two that ask do not see each other
        return not free
