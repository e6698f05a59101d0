"""Every source lists shapes deterministically, loads them, pickles, and names what is wrong with its root."""

import io
import json
import os
import pickle
import random
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest
import trimesh

from sdfhub import procedural
from sdfhub.data.preparation.settings import Preparation
from sdfhub.data.sources import DeepSdfSource, FolderSource, OpenSource, ProceduralSource, ShapeNetSource
from sdfhub.data.sources.deepsdf import read_samples
from sdfhub.data.sources.source import Shape
from sdfhub.data.store.store import prepare
from sdfhub.errors import RejectedMesh, SdfhubError
from tests.categories import CATEGORIES

BALL = trimesh.creation.icosphere(subdivisions=2)
OBJ = BALL.export(file_type="obj").encode()


def put(path: Path, content: bytes = OBJ) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    return path


def ids(source) -> list[str]:
    return [shape.id for shape in source.shapes()]


def samples_file(path: Path, inside: int = 40, **arrays) -> Path:
    rows = np.random.default_rng(0).uniform(0.1, 0.5, (100, 4)).astype(np.float32)
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, **{"pos": rows, "neg": rows[:inside] * [1, 1, 1, -1]} | arrays)
    return path


def test_procedural_shapes_do_not_depend_on_the_count():
    categories = {name: {} for name in procedural.CATEGORIES}
    few, many = ProceduralSource(categories, 3), ProceduralSource(categories, 1000)
    assert few.shapes()[:3] == many.shapes()[:3] and len(many.shapes()) == 1000 * len(categories)
    assert few.shapes()[0].id == "chairs/0000"
    vertices, faces = pickle.loads(pickle.dumps(few)).load(few.shapes()[1])
    again = many.load(many.shapes()[1])
    assert np.array_equal(vertices, again[0]) and np.array_equal(faces, again[1])


def test_procedural_refuses_what_it_cannot_make():
    with pytest.raises(SdfhubError, match="category=boats"):
        ProceduralSource({"boats": {}})


@pytest.mark.parametrize("layout", ["model.obj", "models/model_normalized.obj"])
def test_shapenet_of_both_versions_with_deepsdf_splits(tmp_path, layout):
    synset = CATEGORIES["chairs"]["synset"]
    for model in ("aa", "bb", "c (1)"):
        put(tmp_path / "tree" / synset / model / layout)
    (tmp_path / "tree" / synset / "empty").mkdir()
    splits = {}
    for role, models in (("train", ["aa", "gone"]), ("test", ["c (1)"])):
        listed = json.dumps({"ShapeNetV2": {synset: models}}).encode()
        splits[f"{role}_split"] = str(put(tmp_path / role, listed))
    categories = {"chairs": CATEGORIES["chairs"]}
    assert ids(ShapeNetSource(categories, str(tmp_path / "tree"))) == [
        "chairs/aa",
        "chairs/bb",
        "chairs/c_1_",
    ]
    source = ShapeNetSource(categories, str(tmp_path / "tree"), **splits)
    assert [(s.id, s.split) for s in source.shapes()] == [("chairs/aa", "train"), ("chairs/c_1_", "held_out")]
    for shape in source.shapes():
        assert len(pickle.loads(pickle.dumps(source)).load(shape)[1]) == len(BALL.faces)


def test_shapenet_names_what_is_missing(tmp_path):
    with pytest.raises(SdfhubError, match="no such folder"):
        ShapeNetSource(CATEGORIES, str(tmp_path / "gone")).shapes()
    with pytest.raises(SdfhubError, match=CATEGORIES["chairs"]["synset"]):
        ShapeNetSource({"chairs": CATEGORIES["chairs"]}, str(tmp_path)).shapes()
    with pytest.raises(SdfhubError, match=r"category\.chairs\.synset"):
        ShapeNetSource({"chairs": {"synset": 3001627}}, str(tmp_path))


def test_folder_takes_its_category_from_the_first_subfolder(tmp_path):
    for name in ("b.obj", "ä b.OBJ", "x/one.obj", "x/y/one.obj", ".hidden/z.obj", "notes.txt"):
        put(tmp_path / name)
    source = FolderSource(str(tmp_path))
    shapes = source.shapes()
    assert [s.category for s in shapes] == ["folder", "folder", "x", "x"]
    assert ids(source)[2:] == ["x/one", "x/y_one"] and ids(source)[0].startswith("folder/b")
    for shape in shapes:
        assert len(pickle.loads(pickle.dumps(source)).load(shape)[1]) == len(BALL.faces)


def test_files_that_share_an_id_are_kept_apart(tmp_path):
    for name in ("a.obj", "a.off", "a b.obj", "a_b.obj"):
        put(tmp_path / name, BALL.export(file_type=name[-3:]).encode())
    assert len(set(ids(FolderSource(str(tmp_path))))) == 4


def test_folder_fingerprints_follow_content_not_dates(tmp_path):
    path = put(tmp_path / "a.obj")
    source = FolderSource(str(tmp_path))
    before = source.shapes()
    os.utime(path, (1, 1))
    assert source.shapes() == before
    put(path, OBJ + b"# changed")
    assert source.shapes()[0].fingerprint != before[0].fingerprint


def test_folder_honours_one_split_file_for_both_sides(tmp_path):
    for name in ("a", "sub/b", "sub/c"):
        put(tmp_path / "m" / f"{name}.obj")
    split = str(
        put(tmp_path / "split.json", json.dumps({"train": ["a", "sub/b"], "held_out": ["c"]}).encode())
    )
    shapes = FolderSource(str(tmp_path / "m"), split, split).shapes()
    assert [(s.id, s.split) for s in shapes] == [
        ("folder/a", "train"),
        ("sub/b", "train"),
        ("sub/c", "held_out"),
    ]


def test_a_name_that_is_a_path_means_that_file_alone(tmp_path):
    for name in ("a", "sub/a", "sub/b"):
        put(tmp_path / "m" / f"{name}.obj")
    split = str(put(tmp_path / "split.json", json.dumps({"train": ["sub/a"], "test": ["a", "b"]}).encode()))
    shapes = FolderSource(str(tmp_path / "m"), split, split).shapes()
    roles = {shape.id: shape.split for shape in shapes}
    assert roles == {"folder/a": "held_out", "sub/a": "train", "sub/b": "held_out"}


@pytest.mark.parametrize(
    "content, message",
    [
        (b"{]", "not JSON"),
        (b'{"a": 3}', "expected"),
        (b'["nothing"]', "none of the 1"),
        (b'{"train": ["a"], "test": ["a"]}', "in the training split as well"),
    ],
)
def test_wrong_split_files_are_named(tmp_path, content, message):
    put(tmp_path / "m" / "a.obj")
    split = str(put(tmp_path / "split.json", content))
    with pytest.raises(SdfhubError, match=rf"split\.json.*{message}"):
        FolderSource(str(tmp_path / "m"), split, split).shapes()


def test_an_empty_or_missing_folder_is_named(tmp_path):
    for source in (FolderSource, DeepSdfSource):
        with pytest.raises(SdfhubError, match=r"data\.source\.root=.*holds no"):
            source(str(tmp_path)).shapes()
        with pytest.raises(SdfhubError, match=r"data\.source\.root=.*no such folder"):
            source(str(tmp_path / "gone")).shapes()
    with pytest.raises(SdfhubError, match="make data"):
        OpenSource(CATEGORIES, str(tmp_path)).shapes()


def test_two_roots_have_two_names(tmp_path):
    assert FolderSource(str(tmp_path / "a")).name != FolderSource(str(tmp_path / "b")).name


def test_deepsdf_samples_keep_sign_and_frame(tmp_path):
    samples_file(tmp_path / "SdfSamples/ShapeNetV2/03001627/aa.npz")
    samples_file(tmp_path / "SdfSamples/ShapeNetV2/00000001/bb.npz")
    frame = tmp_path / "NormalizationParameters/ShapeNetV2/03001627/aa.npz"
    samples_file(frame, offset=np.array([1.0, 2, 3]), scale=np.array([2.0]))
    assert ids(DeepSdfSource(str(tmp_path), CATEGORIES)) == ["chairs/aa"]
    source = DeepSdfSource(str(tmp_path))
    assert ids(source) == ["ShapeNetV2_00000001/bb", "ShapeNetV2_03001627/aa"]
    samples = source.load(source.shapes()[1])
    assert (samples.sdf < 0).sum() == 40 and len(samples.points) == 140 and samples.mesh is None
    assert samples.frame.center.tolist() == [-1, -2, -3] and samples.frame.scale == 2
    assert len(samples.surface_points) == 0


def test_deepsdf_drops_rows_with_nan(tmp_path):
    rows = np.ones((10, 4), dtype=np.float32)
    rows[3, 3] = np.nan
    samples_file(tmp_path / "a.npz", pos=rows)
    source = DeepSdfSource(str(tmp_path))
    assert len(source.load(source.shapes()[0]).points) == 49


@pytest.mark.parametrize(
    "arrays",
    [
        {"pos": np.zeros((3, 3))},
        {"pos": np.zeros((3, 4), dtype=int)},
        {"pos": np.array([{}], dtype=object)},
        {"neg": np.zeros((0, 4))},
    ],
)
def test_deepsdf_refuses_strange_arrays(tmp_path, arrays):
    samples_file(tmp_path / "a.npz", **arrays)
    source = DeepSdfSource(str(tmp_path))
    with pytest.raises(RejectedMesh, match=r"a\.npz"):
        source.load(source.shapes()[0])


def test_deepsdf_believes_no_claims(tmp_path):
    path = samples_file(tmp_path / "a.npz")
    path.write_bytes(path.read_bytes()[:900])
    source = DeepSdfSource(str(tmp_path))
    with pytest.raises(RejectedMesh, match="corrupt_file"):
        source.load(source.shapes()[0])
    header = io.BytesIO()
    claim = {"descr": "<f4", "fortran_order": False, "shape": (10**12, 4)}
    np.lib.format.write_array_header_1_0(header, claim)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("pos.npy", header.getvalue())
    with pytest.raises(RejectedMesh, match="corrupt_file"):
        source.load(source.shapes()[0])


@pytest.mark.parametrize("compressed", [True, False])
def test_no_flipped_bit_of_deepsdfs_samples_is_taken(compressed, tmp_path):
    rows = np.random.default_rng(0).uniform(0.1, 0.5, (100, 4)).astype(np.float32)
    path, chance = tmp_path / "a.npz", random.Random(0)
    (np.savez_compressed if compressed else np.savez)(path, pos=rows, neg=rows * [1, 1, 1, -1])
    whole, refused = path.read_bytes(), 0
    points = read_samples(path).points
    for _ in range(200):
        broken, bit = bytearray(whole), chance.randrange(8 * len(whole))
        broken[bit // 8] ^= 1 << bit % 8
        path.write_bytes(broken)
        try:
            assert np.array_equal(read_samples(path).points, points)  # a date, a flag without a meaning
        except RejectedMesh as rejection:
            refused += 1
            assert "a.npz" in str(rejection)
    assert refused > 100


@pytest.mark.parametrize("shape", [(-1, 4), (10**13, 4), (3, 10**30)])
def test_shapes_that_no_array_has_are_refused(shape, tmp_path):
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f4", "fortran_order": False, "shape": shape})
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("pos.npy", header.getvalue() + bytes(1000))
    with pytest.raises(RejectedMesh, match="corrupt_file"):
        read_samples(tmp_path / "a.npz")


def test_a_header_that_unpacks_to_gigabytes_is_refused_before_it_does(tmp_path):
    claim = b"\x93NUMPY\x02\x00" + (1 << 31).to_bytes(4, "little") + b" " * (64 << 20)
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("pos.npy", claim)
    tracemalloc.start()
    with pytest.raises(RejectedMesh, match="corrupt_file"):
        read_samples(tmp_path / "a.npz")
    assert tracemalloc.get_traced_memory()[1] < 8 << 20
    tracemalloc.stop()


def test_samples_whose_frame_has_changed_are_other_samples(tmp_path):
    samples_file(tmp_path / "SdfSamples/d/c/aa.npz")
    frame = tmp_path / "NormalizationParameters/d/c/aa.npz"
    samples_file(frame, offset=np.zeros(3), scale=np.ones(1))
    before = DeepSdfSource(str(tmp_path)).shapes()[0].fingerprint
    samples_file(frame, offset=np.ones(3), scale=np.ones(1))
    assert DeepSdfSource(str(tmp_path)).shapes()[0].fingerprint != before


@pytest.mark.parametrize(
    "id", ["../a", "/a", "a/../b", "a//b", "a/", ".a", "a/.b", "a b", "a\nb", "a/b\n", "ä", ""]
)
def test_an_id_that_is_no_safe_path_is_refused(id):
    with pytest.raises(ValueError, match="shape id"):
        Shape(id, "chairs", "v1")


def test_deepsdf_samples_go_into_the_store(tmp_path):
    samples_file(tmp_path / "npz" / "a.npz")
    source = DeepSdfSource(str(tmp_path / "npz"))
    stored = prepare(source, source.shapes(), Preparation(), tmp_path / "store", workers=1)
    shape = stored["folder/a"]
    assert [len(shape.read(name)) for name in ("outside", "inside", "surface")] == [100, 40, 0]
    assert shape.mesh is None


def test_meshes_of_a_folder_go_into_the_store(tmp_path):
    put(tmp_path / "m" / "ball.obj")
    put(tmp_path / "m" / "broken.obj", b"v 0 0 0\n")
    source = FolderSource(str(tmp_path / "m"))
    settings = Preparation(samples=2000, surface_points=100)
    stored = prepare(source, source.shapes(), settings, tmp_path / "store", workers=1)
    assert list(stored) == ["folder/ball"] and stored.rejected["folder/broken"].reason == "no_faces"
    rows = np.concatenate([stored["folder/ball"].read("outside"), stored["folder/ball"].read("inside")])
    assert len(rows) == 2000
    radius = np.linalg.norm(rows[:, :3], axis=1)
    assert np.abs(rows[:, 3] - (radius - 1 / 1.03)).max() < 0.02  # the ball has flat faces
    assert len(stored["folder/ball"].mesh.faces) == len(BALL.faces)


def test_ids_do_not_depend_on_how_a_root_is_spelled(tmp_path, monkeypatch):
    for name in ("m/chair.obj", "m/chair.off"):
        put(tmp_path / name, BALL.export(file_type=name[-3:]).encode())
    monkeypatch.chdir(tmp_path)
    assert ids(FolderSource("m")) == ids(FolderSource(str(tmp_path / "m"))) == ids(FolderSource("./m/../m"))


def test_a_file_named_in_another_encoding_is_prepared_once(tmp_path):
    name = os.fsdecode(b"ch\xe9ise.obj")
    put(tmp_path / "m" / name)
    few = Preparation(samples=500, surface_points=100)
    source = FolderSource(str(tmp_path / "m"))
    prepare(source, source.shapes(), few, tmp_path / "store", workers=1)
    (record,) = (tmp_path / "store").glob("**/*.safetensors")
    made = record.stat().st_mtime_ns
    assert len(prepare(source, source.shapes(), few, tmp_path / "store", workers=1)) == 1
    assert record.stat().st_mtime_ns == made, "its record can be read again"


def test_names_of_a_split_that_are_not_there_are_told(tmp_path, caplog):
    put(tmp_path / "m" / "a.obj")
    split = str(put(tmp_path / "split.json", b'["a", "b.obj", "typo"]'))
    assert ids(FolderSource(str(tmp_path / "m"), split)) == ["folder/a"]
    assert "2 of the 3 train shapes it lists are not there, such as b.obj" in caplog.text


def test_samples_of_another_frame_are_refused(tmp_path):
    rows = np.random.default_rng(0).uniform(1, 100, (100, 4)).astype(np.float32)
    with pytest.raises(RejectedMesh, match=r"wrong_frame: .*a\.npz: has points 9\d"):
        read_samples(samples_file(tmp_path / "a.npz", pos=rows))


def test_categories_of_a_folder_are_its_first_subfolders(tmp_path):
    for name in ("chairs/a", "chairs/b", "my lamps/c", "d"):
        put(tmp_path / f"{name}.obj")
    assert ids(FolderSource(str(tmp_path), categories={})) == [
        "chairs/a",
        "chairs/b",
        "folder/d",
        "my_lamps/c",
    ]
    assert ids(FolderSource(str(tmp_path), categories={"chairs": {}})) == ["chairs/a", "chairs/b"]
    assert ids(FolderSource(str(tmp_path), categories=["my_lamps"])) == ["my_lamps/c"]
    with pytest.raises(SdfhubError, match=r"category=sofas: .* but chairs, folder, my_lamps;"):
        FolderSource(str(tmp_path), categories=["sofas"]).shapes()


def test_a_root_means_the_same_from_any_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    sources = [FolderSource("my meshes", "split.json"), DeepSdfSource("my meshes", train_split="split.json")]
    sources.append(ShapeNetSource({"chairs": CATEGORIES["chairs"]}, "my meshes", "split.json"))
    for source in sources:
        assert source.root == tmp_path / "my meshes" and source.train_split == str(tmp_path / "split.json")
