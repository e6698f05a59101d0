"""The open meshes: fetched safely, chosen by name, credited, without twins."""

import io
import lzma
import os
import pickle
import shutil
import tarfile
import zipfile
from pathlib import Path

import numpy as np
import pytest
import trimesh

from sdfhub.data import fetch
from sdfhub.data.sources import OpenSource
from sdfhub.errors import RejectedMesh, SdfhubError
from tests.categories import CATEGORIES, NAMES, ROOT

OPEN = ROOT / "data" / "open"
BALL = trimesh.creation.icosphere(subdivisions=2)
OBJ = BALL.export(file_type="obj").encode()
needs_dpkg = pytest.mark.skipif(not shutil.which("dpkg-deb"), reason="Debian's tool")
needs_open = pytest.mark.skipif(not OPEN.is_dir(), reason="data/open is not there: run `make data`")


def library(path: Path, models: dict[str, bytes], catalogue: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("PluginFurnitureCatalog.properties", catalogue.encode("latin-1"))
        for name, content in models.items():
            archive.writestr(name, content)


CATALOGUE = """# of the test
license=CC0 \\
  for all
name#1=Bar St\\u00f6ol, a stool
model#1=/shop/stool/stool.obj
creator#1=A. Maker
name#2=Stool in red
model#2=/shop/red.obj
creator#2=B. Maker
license#2=CC-BY
name#3=Chair outside
model#3=/../../etc/chair.obj
name#4=Chair of another kind
model#4=/shop/chair.dae
name#5=Chair
model#5=/shop/chair.obj
name#6=Sofa and chair
model#6=/shop/chair.obj
name#7=Broken seat
model#7=/shop/broken.obj
"""


@pytest.fixture
def furniture(tmp_path) -> Path:
    models = {"shop/stool/stool.obj": OBJ, "shop/red.obj": b"# red\n" + OBJ, "shop/chair.dae": b"<x/>"}
    big = BALL.copy().apply_scale(2).export(file_type="obj").encode()
    models |= {"../../etc/chair.obj": OBJ, "shop/chair.obj": big, "shop/broken.obj": b"nothing"}
    library(tmp_path / "open" / "a.sh3f", models, CATALOGUE)
    return tmp_path / "open"


def test_furniture_is_chosen_by_name_with_its_credits(furniture):
    source = OpenSource({"chairs": CATEGORIES["chairs"]}, str(furniture))
    shapes = source.shapes()
    titles = [shape.credits["title"] for shape in shapes]
    assert titles == ["Bar Stöol, a stool", "Chair"]  # not its red twin, outsiders, the broken one
    assert shapes[0].credits | {"title": ""} == {"author": "A. Maker", "licence": "CC0 for all", "title": ""}
    assert len(pickle.loads(pickle.dumps(source)).load(shapes[0])[1]) == len(BALL.faces)
    assert shapes == OpenSource({"chairs": CATEGORIES["chairs"]}, str(furniture)).shapes()  # from the cache


def test_a_changed_library_is_measured_again(furniture):
    source = OpenSource({"chairs": CATEGORIES["chairs"]}, str(furniture))
    before = source.shapes()
    library(furniture / "a.sh3f", {"shop/chair.obj": OBJ + b"# changed"}, CATALOGUE)
    after = source.shapes()
    assert len(after) == 1 and after[0].id == before[1].id and after[0].fingerprint != before[1].fingerprint


def test_a_zip_bomb_is_refused(furniture, monkeypatch):
    source = OpenSource({"chairs": CATEGORIES["chairs"]}, str(furniture))
    shape = source.shapes()[0]
    monkeypatch.setattr("sdfhub.data.sources.open.MAX_MODEL", 1000)
    with pytest.raises(RejectedMesh, match="corrupt_file"):
        source.load(shape)


def test_a_library_whose_packed_bytes_are_damaged_is_named(furniture):
    source = OpenSource({"chairs": CATEGORIES["chairs"]}, str(furniture))
    shape, path = source.shapes()[0], furniture / "a.sh3f"
    content = bytearray(path.read_bytes())
    at = content.index(b"shop/stool/stool.obj") + 20
    content[at : at + 9] = b"\xff" * 9
    path.write_bytes(content)
    with pytest.raises(RejectedMesh, match=r"a\.sh3f.*stool\.obj"):
        source.load(shape)
    at = content.index(b"PluginFurnitureCatalog.properties") + 33
    content[at : at + 9] = b"\xff" * 9
    path.write_bytes(content)
    with pytest.raises(SdfhubError, match=r"a\.sh3f: not a furniture library"):
        source.shapes()


@pytest.mark.parametrize(
    "change, message",
    [
        ({"include": "("}, r"catalogue\.include"),
        ({"exclude": "x"}, r"catalogue\.include"),
        ({"include": "x", "exlcude": "x"}, r"category\.chairs\.catalogue\.exlcude"),
    ],
)
def test_wrong_rules_name_their_key(change, message):
    with pytest.raises(SdfhubError, match=message):
        OpenSource({"chairs": {"catalogue": change}})


@needs_open
def test_open_reaches_the_expected_counts():
    wanted = {"chairs": 70, "sofas": 23, "tables": 45, "lamps": 29, "planes": 113}
    categories = [shape.category for shape in OpenSource(CATEGORIES, str(OPEN)).shapes()]
    for name, count in wanted.items():
        assert categories.count(name) == pytest.approx(count, rel=0.1), name


@needs_open
def test_open_shapes_load_and_are_credited():
    source = OpenSource(CATEGORIES, str(OPEN))
    shapes = source.shapes()
    assert all(shape.credits["author"] and shape.credits["licence"] for shape in shapes)
    for name in NAMES:
        vertices, faces = source.load(next(shape for shape in shapes if shape.category == name))
        assert len(faces) > 10 and np.isfinite(vertices).all()


def deb(path: Path, members: dict[str, bytes], link: str | None = None) -> Path:
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w") as tar:
        for name, content in members.items():
            info = tarfile.TarInfo(name)
            info.size = len(content)
            tar.addfile(info, io.BytesIO(content))
        if link:
            info = tarfile.TarInfo(link)
            info.type, info.linkname = tarfile.SYMTYPE, "/etc/passwd"
            tar.addfile(info)
    return deb_of(path, packed.getvalue())


def deb_of(path: Path, packed: bytes) -> Path:
    archive = b"!<arch>\n"
    control = lzma.compress(bytes(1024))
    parts = {"debian-binary": b"2.0\n", "control.tar.xz": control, "data.tar.xz": lzma.compress(packed)}
    for name, content in parts.items():
        header = f"{name:<16}{0:<12}{0:<6}{0:<6}{100644:<8}{len(content):<10}`\n".encode()
        archive += header + content + b"\n" * (len(content) % 2)
    path.write_bytes(archive)
    return path


@needs_dpkg
def test_packages_put_there_by_hand_are_unpacked_safely(tmp_path):
    members = {"./usr/share/x/a.sh3f": b"A", "./usr/doc/copyright": b"C", "./usr/bin/tool": b"T"}
    deb(tmp_path / "sweethome3d-furniture_1_all.deb", members, link="./usr/link.sh3f")
    deb(tmp_path / "flightgear-data-ai_1_all.deb", {"./usr/AI/Aircraft/p/p.ac": b"AC3Db"})
    assert fetch.main(["--root", str(tmp_path)]) == 0
    there = [path for path in tmp_path.rglob("*") if path.is_file() and path.name != ".lock"]
    files = {str(path.relative_to(tmp_path)) for path in there if path.suffix != ".deb"}
    assert files == {
        "sweethome3d-furniture/usr/share/x/a.sh3f",
        "sweethome3d-furniture/usr/doc/copyright",
        "flightgear-data-ai/usr/AI/Aircraft/p/p.ac",
    }
    assert not any(path.is_symlink() for path in tmp_path.rglob("*"))
    assert fetch.main(["--root", str(tmp_path)]) == 0  # and again, with nothing to do


def test_a_missing_package_says_which_files_to_get(tmp_path, monkeypatch, capsys):
    deb(tmp_path / "sweethome3d-furniture_1_all.deb", {"a.sh3f": b"A"})  # of no use without dpkg-deb
    monkeypatch.setattr(fetch.shutil, "which", lambda name: None)
    assert fetch.main(["--root", str(tmp_path)]) == 2
    message = capsys.readouterr().err
    assert all(name in message for name in (*fetch.PACKAGES, str(tmp_path))) and message.count("\n") == 1


@needs_dpkg
@pytest.mark.parametrize("fault", [3, 100, -40, "../../evil.sh3f"])
def test_a_cut_or_evil_package_leaves_nothing_behind(tmp_path, capsys, fault):
    name = fault if isinstance(fault, str) else "a.sh3f"
    path = deb(tmp_path / "sweethome3d-furniture_1_all.deb", {name: os.urandom(5000)})
    if isinstance(fault, int):
        path.write_bytes(path.read_bytes()[:fault])
    assert fetch.main(["--root", str(tmp_path)]) == 2
    assert "not a whole .deb" in capsys.readouterr().err
    assert {file.name for file in tmp_path.rglob("*")} == {path.name, ".lock"}
