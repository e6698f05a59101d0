"""The store of prepared shapes: whole, reused, independent of order and workers."""

import dataclasses
import os
import pickle
import time

import numpy as np
import pytest
from safetensors.numpy import load_file

from sdfhub.data.preparation.settings import Preparation
from sdfhub.data.sources.source import Shape, Source
from sdfhub.data.store import store
from sdfhub.data.store.store import Store, prepare, prepare_part
from sdfhub.errors import RejectedMesh, SdfhubError
from sdfhub.shapes import Frame, NormalizedMesh, ShapeSamples

SETTINGS = Preparation()


class Balls(Source):
    """Ready-made samples of spheres, with a few that misbehave by name."""

    name = "balls"

    def __init__(self, count: int = 4, bad: dict[str, str] | None = None):
        self.bad = bad or {}
        ids = [f"balls/{index:04d}" for index in range(count)] + sorted(self.bad)
        self.listed = [Shape(id, "balls", f"v1 {id}", credits={"author": "A", "licence": "B"}) for id in ids]

    def shapes(self) -> list[Shape]:
        return self.listed

    def load(self, shape: Shape) -> ShapeSamples:
        match self.bad.get(shape.id):
            case "reject":
                raise RejectedMesh("few_faces", "3 faces")
            case "raise":
                raise ZeroDivisionError("surprise")
            case "die":
                os._exit(9)
        return ball(seed=store.shape_seed(shape))


def ball(seed: int, rows: int = 300) -> ShapeSamples:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (rows, 3)).astype(np.float32)
    sdf = (np.linalg.norm(points, axis=1) - 0.9).astype(np.float32)
    normals = rng.normal(size=(50, 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    corners = np.array([[0.9, 0, 0], [0, 0.9, 0], [0, 0, 0.9], [0, 0, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int64)
    frame = Frame(np.array([1.0, 2.0, 3.0]), 2.0)
    mesh = NormalizedMesh(corners, faces, frame)
    return ShapeSamples(points, sdf, 0.9 * normals, normals, frame, mesh, {"inside": 0.4})


def fill(root, source, **settings) -> Store:
    settings = {"preparation": SETTINGS, "workers": 1} | settings
    return prepare(source, source.shapes(), root=root, **settings)


def content(prepared: Store) -> dict[str, dict[str, bytes]]:
    """The arrays of each shape, as another reader of safetensors sees them."""
    arrays = {shape.id: load_file(shape.path) for shape in prepared.values()}
    return {id: {name: array.tobytes() for name, array in found.items()} for id, found in arrays.items()}


@pytest.fixture
def loaded(monkeypatch) -> list[str]:
    """Ids of the shapes that the source is asked to load from now on."""
    ids, load = [], Balls.load
    monkeypatch.setattr(Balls, "load", lambda self, shape: ids.append(shape.id) or load(self, shape))
    return ids


def test_rows_are_kept_and_parted_by_sign(tmp_path):
    source = Balls(1)
    shape = fill(tmp_path, source)["balls/0000"]
    samples = source.load(source.listed[0])
    rows = np.column_stack([samples.points, samples.sdf])
    kept = np.concatenate([shape.read("outside"), shape.read("inside")])
    assert (shape.read("outside")[:, 3] >= 0).all() and (shape.read("inside")[:, 3] < 0).all()
    assert np.array_equal(np.unique(kept, axis=0), np.unique(rows, axis=0))
    assert not np.array_equal(shape.read("outside"), rows[rows[:, 3] >= 0])  # shuffled
    pairs = {tuple(row) for row in np.column_stack([samples.surface_points, samples.surface_normals])}
    assert {tuple(row) for row in shape.read("surface")} == pairs  # point and normal stay together
    assert shape.rows("surface") == 50 and shape.record.statistics == {"inside": 0.4}
    assert shape.credits == {"author": "A", "licence": "B"}


def test_mesh_and_frame_survive(tmp_path):
    shape = fill(tmp_path, Balls(1))["balls/0000"]
    expected = ball(0).mesh
    assert np.array_equal(shape.mesh.vertices, expected.vertices) and shape.mesh.faces.dtype == np.int64
    assert np.array_equal(shape.mesh.faces, expected.faces)
    assert shape.frame.scale == 2.0 and shape.frame.center.tolist() == [1.0, 2.0, 3.0]


def test_neither_order_nor_workers_change_a_byte(tmp_path):
    source = Balls(3)
    here = fill(tmp_path / "a", source)
    source.listed = source.listed[::-1]
    there = fill(tmp_path / "b", source, workers=2)
    assert content(here) == content(there) and len(content(here)) == 3


def test_second_run_loads_nothing(tmp_path, loaded):
    fill(tmp_path, Balls(3))
    loaded.clear()
    assert fill(tmp_path, Balls(3)).keys() == {"balls/0000", "balls/0001", "balls/0002"} and not loaded


def test_a_changed_fingerprint_prepares_that_shape_again(tmp_path, loaded):
    source = Balls(3)
    before = fill(tmp_path, source)
    loaded.clear()
    source.listed[1] = dataclasses.replace(source.listed[1], fingerprint="v2")
    after = fill(tmp_path, source)
    assert loaded == ["balls/0001"] and after.folder == before.folder
    assert after["balls/0001"].fingerprint == "v2"


def test_every_setting_and_the_version_change_the_folder(monkeypatch):
    hashes = {store.preparation_hash(SETTINGS)}
    for field in dataclasses.fields(Preparation):
        value = getattr(SETTINGS, field.name)
        other = {bool: lambda v: not v, str: lambda v: v + "x", tuple: lambda v: (9.0, *v[1:])}
        changed = other.get(type(value), lambda v: v + 1)(value)
        twin = object.__new__(Preparation)  # past the checks of its values, which are not at stake here
        twin.__dict__.update(vars(SETTINGS) | {field.name: changed})
        hashes.add(store.preparation_hash(twin))
    assert len(hashes) == len(dataclasses.fields(Preparation)) + 1
    monkeypatch.setattr(store, "VERSION", store.VERSION + 1)
    assert store.preparation_hash(SETTINGS) not in hashes


def test_one_bad_mesh_costs_only_itself(tmp_path):
    source = Balls(2, bad={"balls/few": "reject", "balls/odd": "raise"})
    prepared = fill(tmp_path, source)
    assert list(prepared) == ["balls/0000", "balls/0001"]
    assert prepared.rejected["balls/few"].reason == "few_faces"
    assert prepared.rejected["balls/odd"].reason == "error"
    assert "surprise" in prepared.summary() and "2 shapes kept, 2 rejected" in prepared.summary()
    with pytest.raises(SdfhubError, match="few_faces"):
        prepared["balls/few"]


def test_a_dying_worker_costs_only_its_shape(tmp_path):
    prepared = fill(tmp_path, Balls(3, bad={"balls/0000x": "die"}), workers=2)
    assert len(prepared) == 3 and prepared.rejected["balls/0000x"].reason == "crash"


def test_rejections_are_remembered_and_accidents_tried_again(tmp_path, loaded):
    source = Balls(1, bad={"balls/few": "reject", "balls/odd": "raise"})
    fill(tmp_path, source)
    loaded.clear()
    source.bad = {}
    assert len(fill(tmp_path, source)) == 2 and loaded == ["balls/odd"]


def test_a_store_with_nothing_usable_is_an_error(tmp_path):
    with pytest.raises(SdfhubError, match=r"none of the 1 shapes .* few_faces"):
        fill(tmp_path, Balls(0, bad={"balls/few": "reject"}))


def test_parts_are_prepared_apart_and_taken_over(tmp_path, loaded):
    source = Balls(5)
    made = [prepare_part(source, source.listed[i::2], SETTINGS, tmp_path, 1) for i in (0, 1, 1)]
    assert made == [3, 2, 0]
    loaded.clear()
    assert len(fill(tmp_path, source)) == 5 and not loaded


def test_leftovers_of_killed_runs_go_away(tmp_path):
    folder = fill(tmp_path, Balls(1)).folder
    new, old = ".0001.safetensors.0123456789ab", ".0002.safetensors.0123456789ab"
    for name, age in ((old, 9999), (new, 0)):
        (folder / "balls" / name).touch()
        os.utime(folder / "balls" / name, (time.time() - age,) * 2)
    fill(tmp_path, Balls(2))
    assert [path.name for path in (folder / "balls").glob(".*")] == [new]


def test_opening_finds_what_is_there(tmp_path):
    prepared = fill(tmp_path, Balls(2))
    assert list(Store.open(prepared.folder)) == list(prepared)
    for id in ("balls/0007", "../balls/0001"):
        with pytest.raises(SdfhubError, match=f"shape {id} is not there"):
            prepared[id]
    with pytest.raises(SdfhubError, match="holds no prepared shapes"):
        Store.open(tmp_path / "nowhere")


def test_shapes_pickle_without_their_arrays(tmp_path):
    shape = fill(tmp_path, Balls(1))["balls/0000"]
    rows = shape.read("outside")[:5].copy()
    sent = pickle.dumps(shape)
    assert len(sent) < 4000 and np.array_equal(pickle.loads(sent).read("outside")[:5], rows)


def test_empty_arrays_have_their_columns(tmp_path, monkeypatch):
    none = np.zeros((0, 3), dtype=np.float32)
    bare = dataclasses.replace(ball(0), surface_points=none, surface_normals=none, mesh=None)
    monkeypatch.setattr(Balls, "load", lambda *_: bare)
    shape = fill(tmp_path, Balls(1))["balls/0000"]
    assert shape.read("surface").shape == (0, 6) and shape.mesh is None


def test_rows_read_from_disk_are_those_that_safetensors_reads_and_leave_nothing_open(tmp_path):
    for shape in fill(tmp_path, Balls(2)).values():
        for name in ("outside", "inside", "surface"):
            array = load_file(shape.path)[name]
            assert np.array_equal(shape.read(name), array)
            n = len(array)
            for start, count in ((0, 5), (n - 3, 7), (2, 2 * n + 1), (1, 0), (n, 2)):
                wanted = np.take(array, np.arange(start, start + count), axis=0, mode="wrap")
                assert np.array_equal(shape.read(name, start, count), wanted)
    links = (f"/proc/self/fd/{descriptor}" for descriptor in os.listdir("/proc/self/fd"))
    assert not [link for link in links if os.path.realpath(link).endswith(store.SUFFIX)]
