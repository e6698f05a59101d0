"""Human-made meshes under open licences: Sweet Home 3D's furniture and FlightGear's aircraft."""

import hashlib
import json
import re
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from pydantic import BaseModel

from sdfhub.data.sources.mesh_files import MAX_BYTES, triangles_of
from sdfhub.data.sources.source import Shape, Source, folder_safe
from sdfhub.described import check
from sdfhub.errors import RejectedMesh, SdfhubError
from sdfhub.shapes import Mesh
from sdfhub.triangles import face_normals
from sdfhub.whole_file import write_whole

MEASURES = ".measured.json"  # a cache: faces, size and hash of the models seen so far, by file and date
CATALOGUE = "PluginFurnitureCatalog.properties"
MAX_CATALOGUE, MAX_MODEL = 16 << 20, 256 << 20  # bytes unpacked: a small archive may claim any size
AIRCRAFT_CREDITS = {"author": "the FlightGear team", "licence": "GPL-2+"}


class Choice(BaseModel, extra="forbid"):
    """Which models a category takes: regular expressions of their names, lower case, and their least size."""

    include: re.Pattern[str] | None = None
    exclude: re.Pattern[str] | None = None
    min_faces: int = 1

    def takes(self, name: str) -> bool:
        included = not self.include or self.include.search(name.lower())
        return bool(included and not (self.exclude and self.exclude.search(name.lower())))


class Catalogue(Choice):
    """A choice of furniture by its name in the catalogue."""

    include: re.Pattern[str]


class Rules(BaseModel):
    """What a category takes of the two packages; it may have other settings, too."""

    catalogue: Catalogue | None = None
    aircraft: Choice | None = None


class OpenSource(Source):
    """Models of Debian's `sweethome3d-furniture` and `flightgear-data-ai`, chosen by name.

    A category takes the furniture whose catalogue name (lower case) `catalogue.include` finds and
    `catalogue.exclude` does not, or the aircraft files whose path `aircraft.exclude` does not find and
    which have at least `aircraft.min_faces` triangles. Of models with the same extents and surface one is
    kept: catalogues list a chair once per colour.

    Args:
        categories: name -> {catalogue: {include, exclude} or null, aircraft: {exclude, min_faces} or null}.
        root: where `python -m sdfhub.data.fetch` put the two packages; any folders below it are searched.
    """

    name = "open"

    def __init__(self, categories: Mapping[str, Any], root: str = "data/open"):
        self.rules, self.root = check(categories, dict[str, Rules], "category"), Path(root)
        self._places: dict[str, tuple[Path, str]] = {}

    def shapes(self) -> list[Shape]:
        if not self.root.is_dir():
            raise SdfhubError(f"data.source.root={self.root}: no such folder; fetch it with `make data`")
        known: dict[str, dict[str, Any]] = {}
        with suppress(OSError, ValueError, TypeError):
            known |= json.loads((self.root / MEASURES).read_text())
        before, shapes, seen = len(known), [], set()
        for category, choice, file, member, credits in self._candidates():
            state, below = file.stat(), file.relative_to(self.root).as_posix()
            key = f"{below} {state.st_size} {state.st_mtime_ns} {member}"
            measure = known.get(key) or measured(file, member)
            if measure["faces"]:  # a model that cannot be read is tried again: it may be this machine's fault
                known[key] = measure
            twin = (category, measure.get("twin"))
            if measure["faces"] < choice.min_faces or twin in seen:
                continue
            seen.add(twin)
            suffix = hashlib.sha256(f"{below}\n{member}".encode()).hexdigest()[:6]
            id = f"{folder_safe(category)}/{folder_safe(credits['title'].lower())}-{suffix}"
            shapes.append(Shape(id, category, measure["sha256"], credits=credits))
            self._places[id] = file, member
        if len(known) > before:
            with suppress(OSError):  # a root that is read-only is measured every time
                write_whole(self.root / MEASURES, json.dumps(known, indent=1, sort_keys=True))
        if not shapes:
            what = f"no models of {', '.join(self.rules)}; fetch them with `make data`"
            raise SdfhubError(f"data.source.root={self.root}: {what}")
        return sorted(shapes, key=lambda shape: shape.id)

    def load(self, shape: Shape) -> Mesh:
        if shape.id not in self._places:
            self.shapes()
        return read_model(*self._places[shape.id])[0]

    def _candidates(self) -> Iterator[tuple[str, Choice, Path, str, dict[str, str]]]:
        """Category, its choice, file, member of the archive (empty: none) and credits."""
        for category, rules in sorted(self.rules.items()):
            if choice := rules.catalogue:
                for archive in sorted(self.root.rglob("*.sh3f")):
                    for member, credits in furniture_in(archive):
                        if choice.takes(credits["title"]):
                            yield category, choice, archive, member, credits
            if choice := rules.aircraft:
                for file in sorted(self.root.rglob("AI/Aircraft/**/*.ac")):
                    below = file.as_posix().rpartition("AI/Aircraft/")[2]
                    if choice.takes(below):
                        credits = AIRCRAFT_CREDITS | {"title": f"{below.partition('/')[0]} {file.stem}"}
                        yield category, choice, file, "", credits


def measured(file: Path, member: str) -> dict[str, Any]:
    """Faces, hash, and extents and area, which twins share; a model that cannot be read has no faces."""
    try:
        (vertices, faces), sha256 = read_model(file, member)
    except RejectedMesh:
        return {"faces": 0}
    area = np.linalg.norm(face_normals(vertices, faces), axis=1).sum() / 2
    twin = " ".join(f"{value:.4g}" for value in (*np.ptp(vertices[faces.ravel()], axis=0), area))
    return {"faces": len(faces), "twin": twin, "sha256": sha256}


def furniture_in(archive: Path) -> Iterator[tuple[str, dict[str, str]]]:
    """Of a library's OBJ models, in the catalogue's order: name in the archive; author, licence and title."""
    try:
        with zipfile.ZipFile(archive) as library:
            members = set(library.namelist())
        entries = parse_properties(_content(archive, CATALOGUE, MAX_CATALOGUE).decode("latin-1"))
    except Exception as error:  # a damaged archive breaks zipfile and zlib in many ways
        raise SdfhubError(f"{archive}: not a furniture library ({error}); fetch it again") from error
    for number in sorted(int(key[5:]) for key in entries if re.fullmatch(r"name#\d{1,9}", key)):
        entry = {key: entries.get(f"{key}#{number}", "") for key in ("name", "model", "creator", "license")}
        names = (name.lstrip("/") for name in (entry["model"], unquote(entry["model"])))
        member = next((name for name in names if name in members and ".." not in name.split("/")), "")
        if member.lower().endswith(".obj"):
            licence = entry["license"] or entries.get("license", "")
            yield member, {"author": entry["creator"], "licence": licence, "title": entry["name"]}


def read_model(file: Path, member: str) -> tuple[Mesh, str]:
    """The mesh in a file or a member of an archive, of at most MAX_MODEL bytes, and its content's sha256."""
    name = member or file.name
    if file.stat().st_size > MAX_BYTES:
        raise RejectedMesh("corrupt_file", f"{file} is larger than any aircraft or library")
    try:
        content = _content(file, member, MAX_MODEL) if member else file.read_bytes()
    except MemoryError:
        raise
    except Exception as error:  # a damaged archive breaks zipfile and zlib in many ways
        raise RejectedMesh("corrupt_file", f"{file}: {member}: {error}") from error
    mesh = triangles_of(content, Path(name).suffix.lower(), f"{file.name}: {name}")
    return mesh, hashlib.sha256(content).hexdigest()


def parse_properties(text: str) -> dict[str, str]:
    r"""Keys and values of a Java properties file: comments, `\` at a line's end, and `\uXXXX` are known."""
    joined = re.sub(r"\\\r?\n[ \t]*", "", text)
    joined = re.sub(r"\\u([0-9a-fA-F]{4})", lambda match: chr(int(match[1], 16)), joined)
    pairs = re.findall(r"^[ \t]*([^#!\s=:][^\s=:]*)[ \t]*[=:][ \t]*(.*?)[ \t\r]*$", joined, re.MULTILINE)
    return {key: re.sub(r"\\(.)", r"\1", value).strip() for key, value in pairs}


def _content(archive: Path, member: str, limit: int) -> bytes:
    with zipfile.ZipFile(archive) as library, library.open(member) as file:
        content = file.read(limit + 1)  # the size in its header is not to be trusted
    if len(content) > limit:
        raise RejectedMesh("corrupt_file", f"{member} unpacks to more than {limit >> 20} MiB")
    return content
