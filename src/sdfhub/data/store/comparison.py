"""Whether the files of a store are still those that were written, without reading all at every start."""

import json
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

from sdfhub.data.sources.source import state_of
from sdfhub.data.store import shards
from sdfhub.whole_file import write_whole

COMPARED = "compared.json"
"""Beside the manifest: sizes and dates of files whose checksums were right. Without it all are compared."""


def damaged_shapes(records: Mapping[str, Mapping], folder: Path) -> list[str]:
    """Ids of the shapes whose files are not those that were prepared; told by name.

    Files with the size and date that they had when they were last compared are not read again.

    Args:
        records: of shapes, by id.
        folder: of the store.
    """
    compared, states = _compared(folder), _states(records, folder)
    fresh = [id for id, state in states.items() if state is None or compared.get(id) != state]
    with ThreadPoolExecutor() as pool:  # hashing lets other threads run
        found = pool.map(shards.damaged_files, [folder / id for id in fresh], [records[id] for id in fresh])
    names = {id: wrong for id, wrong in zip(fresh, found, strict=True) if wrong}
    for id, wrong in names.items():
        files = ", ".join(f"{name}.npy" for name in wrong)
        print(f"store: {folder / id}: {files} damaged (checksum): prepared again", flush=True)
    if fresh:
        remember({id: records[id] for id in fresh if id not in names}, folder)
    return list(names)


def remember(records: Mapping[str, Mapping], folder: Path) -> None:
    """Notes that the checksums of shapes, given as for `damaged_shapes`, are right."""
    with suppress(OSError):  # a store that others own is read all the same
        write_whole(folder / COMPARED, json.dumps(_compared(folder) | _states(records, folder)))


def _compared(folder: Path) -> dict[str, str]:
    """States of shapes when their checksums were last compared."""
    try:
        return dict(json.loads((folder / COMPARED).read_text()))
    except (OSError, ValueError, TypeError):
        return {}


def _states(records: Mapping[str, Mapping], folder: Path) -> dict[str, str | None]:
    """Sizes and dates of each shape's files; None where one is missing."""
    return {id: _state(folder / id, record) for id, record in records.items()}


def _state(folder: Path, record: Mapping) -> str | None:
    try:
        return " ".join(state_of(folder / f"{name}.npy") for name in sorted(record["files"]))
    except OSError:
        return None
