"""Sweet Home 3D furniture libraries (.sh3f): zip archives of OBJ models with a catalogue of their names."""

import re
import zipfile
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import unquote

from sdfhub.errors import RejectedMesh, SdfhubError

CATALOGUE = "PluginFurnitureCatalog.properties"
MAX_CATALOGUE = 16 << 20
MAX_MODEL = 256 << 20
"""Bytes of one unpacked model: a small archive may claim any size."""


def furniture_in(archive: Path) -> Iterator[tuple[str, dict[str, str]]]:
    """Of a library's OBJ models, in the catalogue's order: name in the archive; author, licence and title.

    Raises:
        SdfhubError: not a zip archive with a catalogue.
    """
    try:
        with zipfile.ZipFile(archive) as library:
            entries = parse_properties(_content(library, CATALOGUE, MAX_CATALOGUE).decode("latin-1"))
            members = set(library.namelist())
    except Exception as error:  # a damaged archive breaks zipfile and zlib in many ways
        raise SdfhubError(f"{archive}: not a furniture library ({error}); fetch it again") from error
    for number in sorted(int(key[5:]) for key in entries if re.fullmatch(r"name#\d{1,9}", key)):
        entry = {key: entries.get(f"{key}#{number}", "") for key in ("name", "model", "creator", "license")}
        names = (name.lstrip("/") for name in (entry["model"], unquote(entry["model"])))
        member = next((name for name in names if name in members and ".." not in name.split("/")), "")
        if member.lower().endswith(".obj"):
            licence = entry["license"] or entries.get("license", "")
            yield member, {"author": entry["creator"], "licence": licence, "title": entry["name"]}


def read_model(archive: Path, member: str) -> bytes:
    """The content of a model within its library.

    Raises:
        RejectedMesh: corrupt_file; the archive is damaged there, or the model larger than MAX_MODEL.
    """
    try:
        with zipfile.ZipFile(archive) as library:
            return _content(library, member, MAX_MODEL)
    except MemoryError:
        raise
    except Exception as error:  # a damaged archive breaks zipfile and zlib in many ways
        raise RejectedMesh("corrupt_file", f"{archive}: {member}: {error}") from error


def parse_properties(text: str) -> dict[str, str]:
    r"""Keys and values of a Java properties file: comments, `\` at a line's end, and `\uXXXX` are known."""
    joined = re.sub(r"\\\r?\n[ \t]*", "", text)
    pairs = re.findall(r"^[ \t]*([^#!\s=:][^\s=:]*)[ \t]*[=:][ \t]*(.*?)[ \t\r]*$", joined, re.MULTILINE)
    return {key: _unescaped(value) for key, value in pairs}


def _unescaped(value: str) -> str:
    letters = re.sub(r"\\u([0-9a-fA-F]{4})", lambda match: chr(int(match[1], 16)), value)
    return re.sub(r"\\(.)", r"\1", letters).strip()


def _content(library: zipfile.ZipFile, member: str, limit: int) -> bytes:
    with library.open(member) as file:
        content = file.read(limit + 1)  # the size in its header is not to be trusted
    if len(content) > limit:
        raise RejectedMesh("corrupt_file", f"{member} unpacks to more than {limit >> 20} MiB")
    return content
