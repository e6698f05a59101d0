"""Every reader of a file, given files that are nearly right: it answers, or refuses in one line. Never else.

`FUZZ_EXAMPLES=20000 python -m pytest tests/test_fuzz.py` looks longer (about half an hour) and elsewhere each
time; what it finds becomes an `example` here or a test of its own.
"""

import io
import json
import os
import tarfile
import zipfile
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
import torch
import trimesh
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sdfhub.data import fetch
from sdfhub.data.sources.deepsdf import read_samples
from sdfhub.data.sources.mesh_files import triangles_of
from sdfhub.data.sources.open import furniture_in, read_model
from sdfhub.data.sources.source import Shape, with_roles
from sdfhub.data.store.store import Store
from sdfhub.errors import SdfhubError
from sdfhub.opening import read_run
from sdfhub.report.results import read_sweep
from tests.test_mesh_files import AC3D
from tests.test_open_data import deb, deb_of, needs_dpkg
from tests.test_store import Balls, fill
from tests.tiny import read_weights

EXAMPLES = int(os.environ.get("FUZZ_EXAMPLES", "0"))
fuzzed = settings(
    max_examples=EXAMPLES or 40,
    derandomize=not EXAMPLES,
    deadline=None,
    database=None,
    suppress_health_check=list(HealthCheck),
)

NUMBERS = [b"0", b"-1", b"1", b"3", b"255", b"65536", b"2147483648", b"4294967296", b"99999999999999999999"]
NUMBERS += [b"1e309", b"nan", b"-inf", b"1e-320", b"0x7f", b""]
WORDS = [b"\0", b"\n", b" ", b"{", b"}", b"[", b"]", b'"', b"\\", b"../", b"/etc/passwd", b"\xff\xfe"]
WORDS += [b"null", b"true", b"{}", b"[]", b"&a [*a]", b"!!python/object/apply:os.system [x]"]
WORDS += [b"${oc.env:HOME}", b"\\u0000", b"OBJECT", b"kids 9", b"SURF 0x14", b"end_header"]
WORDS += [b"PK\x03\x04", b"PK\x01\x02", b"PK\x05\x06"]


@st.composite
def nearly(draw, content: bytes) -> bytes:
    """`content` after some accidents: flipped bits, lost, doubled and strange pieces, other numbers."""
    for _ in range(draw(st.integers(1, 4))):
        if not content:
            break
        at = draw(st.integers(0, len(content) - 1))
        length = draw(st.integers(1, 40))
        match draw(st.sampled_from(["bit", "cut", "lose", "double", "word", "number", "bytes"])):
            case "bit":
                content = content[:at] + bytes([content[at] ^ 1 << length % 8]) + content[at + 1 :]
            case "cut":
                content = content[:at]
            case "lose":
                content = content[:at] + content[at + length :]
            case "double":
                content = content[:at] + 2 * content[at : at + length] + content[at + length :]
            case "word":
                content = content[:at] + draw(st.sampled_from(WORDS)) + content[at:]
            case "number":
                content = _other_number(content, at, draw(st.sampled_from(NUMBERS)))
            case "bytes":
                content = content[:at] + draw(st.binary(min_size=1, max_size=8)) + content[at + length :]
    return content


def _other_number(content: bytes, at: int, number: bytes) -> bytes:
    """The first run of digits from `at` on, replaced."""
    digits = b"0123456789.-"
    start = next((i for i in range(at, len(content)) if content[i] in digits), None)
    if start is None:
        return content
    end = next((i for i in range(start, len(content)) if content[i] not in digits), len(content))
    return content[:start] + number + content[end:]


def assert_answers(read) -> object:
    """What `read` returns; None where it refuses in one line, and anything else fails."""
    try:
        return read()
    except SdfhubError as error:
        assert str(error) and len(str(error)) < 5000
        return None


BALL = trimesh.creation.icosphere(subdivisions=1)


def exported(suffix: str, **options) -> bytes:
    content = BALL.export(file_type=suffix, **options)
    return content if isinstance(content, bytes) else content.encode()


MESHES = {
    "ac": (".ac", AC3D),
    "obj": (".obj", exported("obj")),
    "ply": (".ply", exported("ply")),
    "ascii ply": (".ply", exported("ply", encoding="ascii")),
    "stl": (".stl", exported("stl")),
    "ascii stl": (".stl", exported("stl_ascii")),
    "off": (".off", exported("off")),
    "glb": (".glb", exported("glb")),
    "gltf": (".gltf", trimesh.Scene(BALL).export(file_type="gltf")["model.gltf"]),
}


@pytest.mark.parametrize("name", MESHES)
def test_mesh_files(name):
    suffix, content = MESHES[name]

    @fuzzed
    @given(nearly(content))
    def check(broken):
        mesh = assert_answers(lambda: triangles_of(broken, suffix, "mesh" + suffix))
        if mesh:
            assert np.isfinite(mesh[0]).all() and 0 <= mesh[1].min() <= mesh[1].max() < len(mesh[0])

    check()


def check_file(content: bytes, read, name: str = "file") -> None:
    """`read` of a file with nearly this content."""

    @fuzzed
    @given(nearly(content))
    def check(broken):
        with TemporaryDirectory() as folder:
            path = Path(folder) / name
            path.write_bytes(broken)
            assert_answers(lambda: read(path))

    check()


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_npz_files(save):
    packed = io.BytesIO()
    rows = np.linspace(0.1, 0.5, 40, dtype=np.float32).reshape(10, 4)
    save(packed, pos=rows, neg=-rows)
    check_file(packed.getvalue(), read_samples, "a.npz")


def test_furniture_libraries():
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as library:
        library.writestr("PluginFurnitureCatalog.properties", "name#1=A chair\\u00e9\nmodel#1=/a/b.obj\n")
        library.writestr("a/b.obj", exported("obj"))

    def read(path: Path):
        for member, _ in furniture_in(path):
            read_model(path, member)

    check_file(packed.getvalue(), read, "a.sh3f")


@pytest.mark.parametrize(
    "content",
    [{"ShapeNetV2": {"03001627": ["a", "b"]}}, ["a", "x/b"], {"train": ["a"], "test": ["b"]}],
    ids=["deepsdf", "list", "roles"],
)
def test_split_files(content):
    shapes = [(Shape(f"chairs/{name}", "chairs", "v1"), name) for name in ("a", "x/b")]
    check_file(json.dumps(content).encode(), lambda path: with_roles(shapes, str(path), str(path)))


@pytest.fixture(scope="module")
def shelf(tmp_path_factory) -> Path:
    return fill(tmp_path_factory.mktemp("store"), Balls(2)).folder


def test_files_of_a_shape(shelf):
    path = shelf / "balls/0000.safetensors"
    content = path.read_bytes()

    @fuzzed
    @given(nearly(content))
    def check(broken):
        path.write_bytes(broken)
        shape = assert_answers(lambda: Store.open(shelf)["balls/0000"])
        if shape:
            assert not shape.is_intact() or len(broken) == len(content), "a checksum finds every change"
            assert_answers(lambda: (shape.read("outside"), shape.read("outside", 1, 5), shape.mesh))

    check()
    path.write_bytes(content)


def test_the_index_of_a_store(shelf):
    path = shelf / "index.json"
    content = path.read_bytes()

    @fuzzed
    @given(nearly(content))
    def check(broken):
        path.write_bytes(broken)
        assert len(fill(shelf.parents[1], Balls(2))) == 2

    check()


def test_checkpoints():
    packed = io.BytesIO()
    torch.save({"state_dict": {"codes.table": torch.zeros(3, 4)}, "global_step": 7}, packed)
    check_file(packed.getvalue(), read_weights, "last.ckpt")


CONFIG = yaml.safe_dump({"seed": 0, "decoder": {"width": 3}, "data": {"source": {"root": "x"}}}).encode()
SPLIT = json.dumps({"train": ["chairs/0001"], "held_out": []}).encode()


@pytest.mark.parametrize("name", ["config.yaml", "split.json"])
def test_runs(name):
    def read(path: Path):
        for other, content in (("config.yaml", CONFIG), ("split.json", SPLIT)):
            if other != name:
                (path.parent / other).write_bytes(content)
        read_run(path.parent)

    check_file({"config.yaml": CONFIG, "split.json": SPLIT}[name], read, name)


CELL = {"folder": "a", "choices": {"sweeps": "s"}, "settings": {}, "seed": 0}
SCORE = {"id": "chairs/1", "cd": 0.1, "floor": 0.01, "cd_penalty": 1.0, "failed": False}
SWEEP = {
    "sweep.json": json.dumps({"version": 1, "cells": [CELL]}).encode(),
    "a/metrics.json": json.dumps(
        {"training": {"seconds": 1.0, "steps": 3, "parameters": 5}, "known": {"shapes": [SCORE]}}
    ).encode(),
    "a/config.yaml": yaml.safe_dump(
        {"data": {"loader": {"shapes_per_step": 1, "samples_per_shape": 2}}, "trainer": {"max_epochs": 3}}
    ).encode(),
    "a/split.json": SPLIT,
}


@pytest.mark.parametrize("name", SWEEP)
def test_sweeps(name, tmp_path):
    @fuzzed
    @given(nearly(SWEEP[name]))
    def check(broken):
        (tmp_path / "a").mkdir(exist_ok=True)
        for other, content in SWEEP.items():
            (tmp_path / other).write_bytes(broken if other == name else content)
        assert_answers(lambda: read_sweep(tmp_path))

    check()


@needs_dpkg
def test_debian_packages(tmp_path):
    content = deb(tmp_path / "a.deb", {"./usr/x/a.sh3f": b"A" * 50, "../b.sh3f": b"B"}).read_bytes()

    def read(path: Path):
        fetch.unpack(path, path.parent / "out", ".sh3f")
        found = [file for file in path.parent.rglob("*") if file.is_file() and file != path]
        assert all(file.resolve().is_relative_to(path.parent / "out") for file in found)

    check_file(content, read, "a.deb")


@needs_dpkg
def test_archives_within_debian_packages():
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w") as tar:
        for name in ("./usr/x/a.sh3f", "copyright"):
            info = tarfile.TarInfo(name)
            info.size = 30
            tar.addfile(info, io.BytesIO(b"x" * 30))

    def read(path: Path):
        fetch.unpack(deb_of(path.with_suffix(".deb"), path.read_bytes()), path.parent / "out", ".sh3f")

    check_file(packed.getvalue()[:2048], read, "a.tar")
