"""Files that are there whole or not at all, however their writer ends; their checksums and locks."""

import hashlib
import logging
import os
import tempfile
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from filelock import FileLock, Timeout

from sdfhub.errors import SdfhubError

log = logging.getLogger(__name__)


@contextmanager
def whole_file(path: Path, beside: str | None = None) -> Iterator[BinaryIO]:
    """A file to write that appears at `path` when all of it is on the disk: a reader sees the old or the new.

    It is written first under the name `beside`; None takes a new one. A fixed name keeps leftovers of killed
    writers from piling up; only one process may then write at a time. An OSError names `path`.
    """
    part = path.with_name(beside or f".{path.name}.{uuid.uuid4().hex[:12]}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.unlink(missing_ok=True)
        with part.open("xb") as file:  # a link that lies there is not followed
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    except OSError as error:
        if error.errno:  # a write that fails does not name its file
            error.filename = str(path)
        raise
    finally:
        with suppress(OSError):  # the first error is the one to report
            part.unlink()


def write_whole(path: Path, content: bytes | str) -> None:
    """Writes a file, text as UTF-8, whole or not at all; see `whole_file`."""
    with whole_file(path) as file:
        file.write(content.encode() if isinstance(content, str) else content)


def refuse_unwritable(folder: Path) -> None:
    """Makes a folder of results; raises SdfhubError where nothing can be written there."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise SdfhubError(f"{folder}: cannot be written ({(error.strerror or '').lower()})") from error


def file_sha256(path: Path) -> str:
    """Hex sha256 of a file's content."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@contextmanager
def locked(path: Path, waiting: str = "") -> Iterator[None]:
    """Holds a lock file, which the system frees however its holder ends; logs `waiting` if it must wait."""
    try:
        held = FileLock(path).acquire(timeout=0)
    except Timeout:
        if waiting:
            log.info(waiting)
        held = FileLock(path).acquire(poll_interval=0.1)
    with held:
        yield
