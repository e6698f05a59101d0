"""Human-made meshes under open licences: Sweet Home 3D's furniture and FlightGear's aircraft."""

import hashlib
import json
import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sdfhub.data.sources.furniture import furniture_in, read_model
from sdfhub.data.sources.mesh_files import MAX_BYTES, triangles_of
from sdfhub.data.sources.source import Shape, Source, folder_safe, plain_categories
from sdfhub.errors import RejectedMesh, SdfhubError
from sdfhub.shapes import Mesh
from sdfhub.triangles import face_normals
from sdfhub.whole_file import write_whole

MEASURES = ".measured.json"
"""Cache below the root: faces, extents, area and hash of the models seen so far, by file size and date."""

AIRCRAFT_CREDITS = {"author": "the FlightGear team", "licence": "GPL-2+"}


@dataclass(frozen=True)
class _Model:
    """A mesh file below the root (`member` empty) or within an archive, and the category it falls into."""

    category: str
    file: Path
    member: str
    title: str
    credits: dict[str, str]

    def content(self) -> bytes:
        if self.member:
            return read_model(self.file, self.member)
        if self.file.stat().st_size > MAX_BYTES:
            raise RejectedMesh("corrupt_file", f"{self.file} is larger than any aircraft")
        return self.file.read_bytes()

    def triangles(self) -> Mesh:
        name = self.member or self.file.name
        return triangles_of(self.content(), Path(name).suffix.lower(), f"{self.file.name}: {name}")

    def key(self, root: Path) -> str:
        state = self.file.stat()
        where = self.file.relative_to(root).as_posix()
        return f"{where} {state.st_size} {state.st_mtime_ns} {self.member}"


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

    def __init__(self, categories: Mapping, root: str = "data/open"):
        self.categories = plain_categories(categories)
        for name, settings in self.categories.items():
            _check_patterns(name, settings)
        self.root = Path(root)
        self._models: dict[str, _Model] = {}

    def shapes(self) -> list[Shape]:
        if not self.root.is_dir():
            raise SdfhubError(f"data.source.root={self.root}: no such folder; fetch it with `make data`")
        known = self._read_measures()
        measured = [(model, self._measure(model, known)) for model in self._candidates()]
        self._write_measures(known)
        self._models, shapes, seen = {}, [], set()
        for model, measure in measured:
            twin = (model.category, measure.get("twin"))
            if measure.get("faces", 0) < self._min_faces(model) or twin in seen:
                continue
            seen.add(twin)
            shapes.append(self._shape(model, measure["sha256"]))
            self._models[shapes[-1].id] = model
        if not shapes:
            what = f"no models of {', '.join(self.categories)}; fetch them with `make data`"
            raise SdfhubError(f"data.source.root={self.root}: {what}")
        return sorted(shapes, key=lambda shape: shape.id)

    def load(self, shape: Shape) -> Mesh:
        if shape.id not in self._models:
            self.shapes()
        return self._models[shape.id].triangles()

    def _candidates(self) -> Iterator[_Model]:
        for name, settings in sorted(self.categories.items()):
            if settings.get("catalogue"):
                yield from self._furniture(name, **settings["catalogue"])
            if settings.get("aircraft"):
                yield from self._aircraft(name, settings["aircraft"].get("exclude"))

    def _furniture(self, category: str, include: str, exclude: str | None = None) -> Iterator[_Model]:
        for archive in sorted(self.root.rglob("*.sh3f")):
            for item in furniture_in(archive):
                title = item.title.lower()
                if re.search(include, title) and not (exclude and re.search(exclude, title)):
                    yield _Model(category, archive, item.member, item.title, item.credits)

    def _aircraft(self, category: str, exclude: str | None) -> Iterator[_Model]:
        for file in sorted(self.root.rglob("AI/Aircraft/**/*.ac")):
            below = file.as_posix().rpartition("AI/Aircraft/")[2]
            if not (exclude and re.search(exclude, below.lower())):
                title = f"{below.partition('/')[0]} {file.stem}"
                yield _Model(category, file, "", title, AIRCRAFT_CREDITS | {"title": title})

    def _min_faces(self, model: _Model) -> int:
        aircraft = {} if model.member else self.categories[model.category]["aircraft"]
        return int(aircraft.get("min_faces", 1))

    def _shape(self, model: _Model, sha256: str) -> Shape:
        where = f"{model.file.relative_to(self.root).as_posix()}\n{model.member}"
        suffix = hashlib.sha256(where.encode()).hexdigest()[:6]
        id = f"{folder_safe(model.category)}/{folder_safe(model.title.lower())}-{suffix}"
        return Shape(id, model.category, sha256, credits=model.credits)

    def _measure(self, model: _Model, known: dict[str, dict]) -> dict:
        key = model.key(self.root)
        if known.get(key, {}).get("faces"):
            return known[key]
        measure = _measured(model)
        if measure["faces"]:  # a model that cannot be read is tried again: the fault may be this machine's
            known[key] = measure
        return measure

    def _read_measures(self) -> dict[str, dict]:
        with suppress(OSError, ValueError):
            known = json.loads((self.root / MEASURES).read_text())
            return known if isinstance(known, dict) else {}
        return {}

    def _write_measures(self, known: dict[str, dict]) -> None:
        content = json.dumps(known, indent=1, sort_keys=True).encode()
        with suppress(OSError):  # a root that is read-only is measured every time
            if not (self.root / MEASURES).is_file() or (self.root / MEASURES).read_bytes() != content:
                write_whole(self.root / MEASURES, content)


_FIELDS = {"catalogue": {"include", "exclude"}, "aircraft": {"exclude", "min_faces"}}


def _check_patterns(category: str, settings: dict) -> None:
    for group, fields in _FIELDS.items():
        given, key = settings.get(group) or {}, f"category.{category}.{group}"
        if not isinstance(given, dict) or not given.keys() <= fields:
            raise SdfhubError(f"{key}: expected {' and '.join(sorted(fields))} or null, got {given}")
        if given and "include" in fields and not given.get("include"):
            raise SdfhubError(f"{key}.include: a regular expression is missing")
        for field in given.keys() & {"include", "exclude"}:
            try:
                re.compile(given[field] or "")
            except (re.error, TypeError) as error:
                raise SdfhubError(f"{key}.{field}={given[field]}: no regular expression: {error}") from error


def _measured(model: _Model) -> dict:
    """Faces, hash, and extents and area, which twins share; a file that cannot be read has no faces."""
    try:
        vertices, faces = model.triangles()
    except RejectedMesh:
        return {"faces": 0}
    extents = np.ptp(vertices[faces.ravel()], axis=0)
    area = np.linalg.norm(face_normals(vertices, faces), axis=1).sum() / 2
    twin = " ".join(f"{value:.4g}" for value in (*extents, area))
    return {"faces": len(faces), "twin": twin, "sha256": hashlib.sha256(model.content()).hexdigest()}
