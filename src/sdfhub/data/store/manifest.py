"""What a store writes down of its shapes, and what it believes when it reads that again."""

import dataclasses
import json
from collections import Counter
from pathlib import Path
from typing import Annotated, Literal

from pydantic import ConfigDict, Field, StringConstraints, TypeAdapter, ValidationError, with_config
from typing_extensions import TypedDict

from sdfhub.data.preparation.settings import Preparation
from sdfhub.shapes import SHAPE_ID
from sdfhub.whole_file import write_whole

VERSION = 2
"""Of the layout on disk and of how samples are made; stores of another version are not reused."""

MANIFEST = "manifest.json"

_OPEN = with_config(ConfigDict(extra="allow", allow_inf_nan=False))


class StoredFile(TypedDict):
    """What is known of one array: rows, bytes and sha256 of its file."""

    rows: Annotated[int, Field(ge=0)]
    bytes: Annotated[int, Field(ge=0)]
    sha256: str


@_OPEN
class Record(TypedDict):
    """What is known of a prepared shape."""

    fingerprint: str
    category: str
    credits: dict[str, str]
    center: Annotated[list[float], Field(min_length=3, max_length=3)]
    scale: Annotated[float, Field(gt=0)]
    statistics: dict[str, float]
    seconds: float
    files: dict[Literal["outside", "inside", "surface", "vertices", "faces"], StoredFile]


class _Refusal(TypedDict):
    reason: str
    detail: str


@_OPEN
class _Kept(Record):
    rejected: None


@_OPEN
class _Refused(TypedDict):
    fingerprint: str
    category: str
    rejected: _Refusal


class _Rejected(_Refusal):
    fingerprint: str
    category: str


@_OPEN
class _Manifest(TypedDict):
    version: Literal[2]
    shapes: dict[Annotated[str, StringConstraints(pattern=SHAPE_ID)], Record]
    rejected: dict[Annotated[str, StringConstraints(pattern=SHAPE_ID)], _Rejected]


_MANIFEST: TypeAdapter = TypeAdapter(_Manifest)
_RECORD: TypeAdapter = TypeAdapter(_Kept | _Refused)


def new_manifest(source: str, preparation: Preparation) -> dict:
    """The manifest of a store without shapes."""
    settings = dataclasses.asdict(preparation)
    return {"version": VERSION, "source": source, "preparation": settings, "shapes": {}, "rejected": {}}


def read_manifest(folder: Path) -> dict | None:
    """The manifest, or None where there is none that this version can read."""
    return _checked(_MANIFEST, folder / MANIFEST)


def checked_record(path: Path) -> dict | None:
    """What `shape.json` says of a shape, kept or rejected, or None where it is not what a store writes."""
    return _checked(_RECORD, path)


def enter(manifest: dict, id: str, record: dict) -> None:
    """Puts a shape's record into the manifest, in place of what it says of the shape."""
    manifest["shapes"].pop(id, None)
    manifest["rejected"].pop(id, None)
    if record["rejected"]:
        entry = {"fingerprint": record["fingerprint"], "category": record["category"]} | record["rejected"]
        manifest["rejected"][id] = entry
    else:
        manifest["shapes"][id] = {key: value for key, value in record.items() if key != "rejected"}


def write_manifest(folder: Path, manifest: dict) -> None:
    """Writes the manifest, its shapes sorted and their authors counted."""
    parts = {key: dict(sorted(manifest[key].items())) for key in ("shapes", "rejected")}
    credited = Counter(
        (record["credits"].get("author", ""), record["credits"].get("licence", ""))
        for record in parts["shapes"].values()
        if record["credits"]
    )
    authors = [{"author": a, "licence": b, "shapes": n} for (a, b), n in sorted(credited.items())]
    write_whole(folder / MANIFEST, json.dumps(manifest | {"credits": authors} | parts, indent=1))


def _checked(schema: TypeAdapter, path: Path) -> dict | None:
    try:
        return schema.validate_json(path.read_bytes())
    except (OSError, ValidationError):
        return None
