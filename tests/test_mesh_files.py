"""Mesh files give the triangles that are in them, or one clear error."""

import json

import numpy as np
import pytest
import trimesh

from sdfhub.data.sources.ac3d import read_ac3d
from sdfhub.data.sources.folder import FolderSource
from sdfhub.data.sources.mesh_files import FORMATS, read_mesh
from sdfhub.errors import RejectedMesh, SdfhubError
from sdfhub.geometry.mesh_file import write_mesh

BALL = trimesh.creation.icosphere(subdivisions=2)
TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"

AC3D = b"""AC3Db
MATERIAL "" rgb 1 1 1  amb 1 1 1  emis 0 0 0  spec 1 1 1  shi 10  trans 0
OBJECT world
kids 2
OBJECT group
name "a wing"
data 14
OBJECT poly
ki
loc 10 0 0
kids 1
OBJECT poly
rot 0 1 0  -1 0 0  0 0 1
loc 1 2 3
numvert 4
0 0 0
1 0 0
1 1 0
0 1 0
numsurf 2
SURF 0x10
mat 0
refs 4
0 0 0
1 1 0
2 1 1
3 0 1
SURF 0x2
refs 2

0 0 0
2 0 0
kids 0
OBJECT poly
numvert 3
0 0 0
1 0 0
0 0 1
numsurf 1
SURF 0x20
mat 0
refs 3
0 0 0
1 0 0
2 0 0
kids 0
"""


def area(vertices: np.ndarray, faces: np.ndarray) -> float:
    return trimesh.Trimesh(vertices, faces, process=False).area


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".stl", ".off", ".glb"])
def test_each_format_gives_the_same_surface(tmp_path, suffix):
    path = tmp_path / f"ball{suffix}"
    BALL.export(path)
    vertices, faces = read_mesh(path)
    assert vertices.dtype == np.float64 and faces.dtype == np.int64
    assert faces.shape == BALL.faces.shape and area(vertices, faces) == pytest.approx(BALL.area, rel=1e-5)


def test_upper_case_suffixes_are_known(tmp_path):
    (tmp_path / "BALL.OBJ").write_text(TRIANGLE)
    assert read_mesh(tmp_path / "BALL.OBJ")[1].tolist() == [[0, 1, 2]]


def test_parts_of_a_scene_are_moved_into_place(tmp_path):
    scene = trimesh.Scene()
    for x in (0.0, 5.0):
        scene.add_geometry(BALL, transform=trimesh.transformations.translation_matrix([x, 0, 0]))
    scene.export(tmp_path / "two.glb")
    vertices, faces = read_mesh(tmp_path / "two.glb")
    assert len(faces) == 2 * len(BALL.faces)
    assert np.ptp(vertices, axis=0) == pytest.approx([7, 2, 2], abs=0.05)


def test_gltf_reads_the_buffers_beside_it_and_no_others(tmp_path):
    inner = tmp_path / "inner"
    inner.mkdir()
    for name, content in trimesh.Scene(BALL).export(file_type="gltf").items():
        (inner / name).write_bytes(content)
    gltf = inner / "model.gltf"
    assert len(read_mesh(gltf)[1]) == len(BALL.faces)
    tree = json.loads(gltf.read_text())
    for buffer in tree["buffers"]:
        (inner / buffer["uri"]).rename(tmp_path / buffer["uri"])
        buffer["uri"] = f"../{buffer['uri']}"
    gltf.write_text(json.dumps(tree))
    with pytest.raises(RejectedMesh, match=r"corrupt_file: .*model\.gltf"):
        read_mesh(gltf)


def test_polygons_negative_indices_and_foreign_letters_in_obj(tmp_path):
    square = "# Möbel\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nusemtl größe\nf -4 -3 -2 -1\n"
    (tmp_path / "square.obj").write_bytes(square.encode("latin-1"))
    assert area(*read_mesh(tmp_path / "square.obj")) == pytest.approx(1)


def test_materials_are_never_looked_up(tmp_path):
    (tmp_path / "a.obj").write_text("mtllib ../../secret.mtl\nusemtl x\n" + TRIANGLE)
    assert len(read_mesh(tmp_path / "a.obj")[1]) == 1


@pytest.mark.parametrize("suffix", [s for s in FORMATS if s != ".gltf"])
@pytest.mark.parametrize("content", [b"", b"  \n", b"\0\xff\x80 rubbish " * 40])
def test_rubbish_is_refused_by_name(tmp_path, suffix, content):
    path = tmp_path / f"rubbish{suffix}"
    path.write_bytes(content)
    with pytest.raises(RejectedMesh, match=f"rubbish{suffix}") as caught:
        read_mesh(path)
    assert caught.value.reason in ("empty_file", "corrupt_file", "no_faces") and "\n" not in str(caught.value)


@pytest.mark.parametrize("suffix", [".ply", ".stl", ".off", ".glb", ".ac"])
def test_truncated_files_are_refused(tmp_path, suffix):
    path = tmp_path / f"cut{suffix}"
    if suffix == ".ac":
        path.write_bytes(AC3D)
    else:
        BALL.export(path)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) * 6 // 10])
    with pytest.raises(RejectedMesh, match="corrupt_file"):
        read_mesh(path)


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".stl", ".off", ".glb"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_vertices_that_are_not_finite_are_found(tmp_path, suffix, value):
    vertices = np.array(BALL.vertices)
    vertices[5, 1] = value
    trimesh.Trimesh(vertices, BALL.faces, process=False, validate=False).export(tmp_path / f"bad{suffix}")
    with pytest.raises(RejectedMesh, match=r"non_finite_vertices: .*bad"):
        read_mesh(tmp_path / f"bad{suffix}")


def test_unused_nan_vertices_in_obj_are_found(tmp_path):
    (tmp_path / "a.obj").write_text("v nan 0 0\n" + TRIANGLE.replace("1 2 3", "2 3 4"))
    with pytest.raises(RejectedMesh, match="non_finite_vertices"):
        read_mesh(tmp_path / "a.obj")


def test_a_point_cloud_has_no_faces(tmp_path):
    trimesh.PointCloud(BALL.vertices).export(tmp_path / "scan.ply")
    with pytest.raises(RejectedMesh, match=r"no_faces: .*scan\.ply"):
        read_mesh(tmp_path / "scan.ply")


def test_a_face_with_a_missing_vertex_is_corrupt(tmp_path):
    (tmp_path / "a.obj").write_text(TRIANGLE.replace("f 1 2 3", "f 1 2 9"))
    with pytest.raises(RejectedMesh, match="corrupt_file"):
        read_mesh(tmp_path / "a.obj")


def test_missing_and_unknown_files_are_named(tmp_path, monkeypatch):
    with pytest.raises(SdfhubError, match=r"gone\.obj: no such file"):
        read_mesh(tmp_path / "gone.obj")
    with pytest.raises(SdfhubError, match=r"a\.blend: not a mesh format"):
        read_mesh(tmp_path / "a.blend")
    (tmp_path / "a.obj").write_text(TRIANGLE)
    monkeypatch.setattr("sdfhub.data.sources.mesh_files.MAX_BYTES", 5)
    with pytest.raises(SdfhubError, match=r"a\.obj: larger"):
        read_mesh(tmp_path / "a.obj")


def test_ac3d_places_nested_objects_and_skips_lines_and_payloads():
    vertices, faces = read_ac3d(AC3D)
    assert len(faces) == 3 and len(vertices) == 7
    quad = {tuple(row) for row in vertices[faces[:2]].reshape(-1, 3).tolist()}
    assert quad == {(11, 2, 3), (11, 3, 3), (10, 3, 3), (10, 2, 3)}  # turned by 90 degrees, then moved twice
    assert area(vertices, faces) == pytest.approx(1.5)


def test_ac3d_survives_every_cut():
    for end in range(len(AC3D)):
        try:
            vertices, faces = read_ac3d(AC3D[:end])
        except RejectedMesh as rejection:
            assert rejection.reason == "corrupt_file"
        else:
            assert not faces.size or faces.max() < len(vertices)


@pytest.mark.parametrize("claim", [b"numvert 999999999999", b"numvert -1", b"data 99999999", b"numvert x"])
def test_ac3d_believes_no_claims(claim):
    with pytest.raises(RejectedMesh, match="corrupt_file"):
        read_ac3d(AC3D.replace(b"numvert 4", claim))


def test_ac3d_nests_as_deep_as_it_likes():
    deep = b"AC3Db\n" + b"OBJECT group\nloc 1 0 0\nkids 1\n" * 5000
    vertices, faces = read_ac3d(deep + AC3D[AC3D.rindex(b"OBJECT poly") :])
    assert faces.tolist() == [[0, 1, 2]] and vertices[0].tolist() == [5000, 0, 0]


@pytest.mark.parametrize("away", [0.0, 4e6])
def test_a_written_ply_keeps_the_digits_of_its_coordinates(away, tmp_path):
    """A scan in geographic coordinates: some metres, millions of metres from the origin."""
    vertices = np.asarray(BALL.vertices) * 5 + away
    write_mesh(vertices, np.asarray(BALL.faces), tmp_path / "ball.ply")
    found, faces = read_mesh(tmp_path / "ball.ply")
    assert np.abs(found - vertices).max() < 1e-5
    assert np.array_equal(faces, BALL.faces)


def test_a_banner_of_comments_before_an_off_takes_no_time(tmp_path):
    """A pattern that backtracks would take longer than anyone waits."""
    (tmp_path / "ball.off").write_bytes(b"#" * 5000 + b"\n" + BALL.export(file_type="off").encode())
    try:
        assert len(read_mesh(tmp_path / "ball.off")[1]) == len(BALL.faces)
    except RejectedMesh as rejection:  # trimesh may not know comments; it must say so at once
        assert rejection.reason == "corrupt_file"


@pytest.mark.parametrize("uri", [None, 7, "a\0b"])
def test_a_gltf_with_a_senseless_buffer_does_not_keep_a_folder_from_being_listed(uri, tmp_path):
    (tmp_path / "bad.gltf").write_text(json.dumps({"buffers": [{"uri": uri}]}))
    (tmp_path / "good.off").write_text(BALL.export(file_type="off"))
    assert len(FolderSource(str(tmp_path)).shapes()) == 2


def gltf_of(folder, change) -> None:
    """Writes model.gltf and its buffers, changed."""
    for name, content in trimesh.Scene(BALL).export(file_type="gltf").items():
        (folder / name).write_bytes(content)
    tree = json.loads((folder / "model.gltf").read_text())
    change(tree)
    (folder / "model.gltf").write_text(json.dumps(tree))


def test_names_of_buffers_are_percent_encoded(tmp_path):
    def spaced(tree):
        for buffer in tree["buffers"]:
            (tmp_path / buffer["uri"]).rename(tmp_path / f"my {buffer['uri']}")
            buffer["uri"] = f"my%20{buffer['uri']}"

    gltf_of(tmp_path, spaced)
    assert len(read_mesh(tmp_path / "model.gltf")[1]) == len(BALL.faces)


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda tree: tree.update(extensionsRequired=["KHR_draco_mesh_compression"]), "compressed: .*draco"),
        (lambda tree: [a.pop("bufferView") for a in tree["accessors"]], "claims numbers that it does not"),
        (lambda tree: tree["nodes"].extend([tree["nodes"][-1]] * 400_000), "too_large: .*vertices"),
        (lambda tree: tree.clear(), "no_faces|corrupt_file"),
    ],
    ids=["compressed", "claimed", "repeated", "nothing"],
)
def test_a_gltf_that_is_not_what_it_says_is_refused(tmp_path, change, words):
    gltf_of(tmp_path, change)
    with pytest.raises(RejectedMesh, match=words):
        read_mesh(tmp_path / "model.gltf")


def test_trouble_of_the_machine_is_no_fault_of_a_mesh(tmp_path, monkeypatch):
    (tmp_path / "a.obj").write_text(TRIANGLE)

    def exhausted(*_):
        raise MemoryError

    monkeypatch.setattr("sdfhub.data.sources.mesh_files._by_trimesh", exhausted)
    with pytest.raises(MemoryError):
        read_mesh(tmp_path / "a.obj")
