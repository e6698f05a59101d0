"""Mesh files from strangers: damaged, lying about themselves, or of odd size and place."""

import dataclasses
import json
import resource
import struct
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest
import trimesh
from manifold3d import Manifold, OpType

from sdfhub.data.preparation.sampling import prepare_mesh
from sdfhub.data.preparation.settings import Preparation
from sdfhub.data.sources.mesh_files import read_mesh
from sdfhub.errors import RejectedMesh
from sdfhub.shapes import Frame
from tests.broken_twins import chair_parts, errors, refined, triangles

BALL = trimesh.creation.icosphere(subdivisions=2)
CHAIR = triangles(refined(Manifold.batch_boolean(chair_parts(), OpType.Add)))
FEW = Preparation(samples=20_000, surface_points=2000)
CLAIM = 4_000_000_000
GIB = 1 << 30


def exported(suffix: str, **options) -> bytes:
    content = BALL.export(file_type=suffix, **options)
    return content if isinstance(content, bytes) else content.encode()


PLY, ASCII_PLY, OFF = exported("ply"), exported("ply", encoding="ascii"), exported("off")
STL, ASCII_STL, OBJ, GLB = exported("stl"), exported("stl_ascii"), exported("obj"), exported("glb")


def glb_claiming(count: int) -> bytes:
    size = struct.unpack("<I", GLB[12:16])[0]
    tree, rest = json.loads(GLB[20 : 20 + size]), GLB[20 + size :]
    for accessor in tree["accessors"]:
        accessor["count"] = count
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 20 + len(text) + len(rest))
    return head + struct.pack("<I4s", len(text), b"JSON") + text + rest


def without_end(content: bytes, lines: int) -> bytes:
    return b"\n".join(content.splitlines()[:-lines]) + b"\n"


AC3D = b"""AC3Db
OBJECT poly
numvert 3
0 0 0
1 0 0
0 1 0
numsurf 1
SURF 0
refs 3
0 0 0
1 0 0
2 0 0
kids 0
"""

LIES = {
    "vertices of a binary .ply": PLY.replace(b"vertex 162", b"vertex %d" % CLAIM),
    "faces of a binary .ply": PLY.replace(b"face 320", b"face %d" % CLAIM),
    "negative faces of a .ply": PLY.replace(b"face 320", b"face -5"),
    "vertices of an ascii .ply": ASCII_PLY.replace(b"vertex 162", b"vertex %d" % CLAIM),
    "faces of an ascii .ply": ASCII_PLY.replace(b"face 320", b"face %d" % CLAIM),
    "one face of an ascii .ply": without_end(ASCII_PLY, 1),
    "index of a .ply": PLY[:-4] + struct.pack("<i", 99_999),
    "triangles of an .stl": STL[:80] + struct.pack("<I", CLAIM) + STL[84:],
    "cut .stl": STL[:-60],
    "cut ascii .stl": ASCII_STL[: len(ASCII_STL) // 2],
    "vertices of an .off": OFF.replace(b"162 320", b"%d 320" % CLAIM),
    "faces of an .off": OFF.replace(b"162 320", b"162 %d" % CLAIM),
    "one face of an .off": without_end(OFF, 1),
    "index of an .off": OFF.rstrip().rsplit(b" ", 1)[0] + b" 99999\n",
    "accessors of a .glb": glb_claiming(CLAIM),
    "accessors beyond memory of a .glb": glb_claiming(10**15),
    "length of a .glb": GLB[:8] + struct.pack("<I", CLAIM) + GLB[12:],
    "json of a .glb": GLB[:12] + struct.pack("<I", CLAIM) + GLB[16:],
    "index of an .obj": OBJ + b"f 1 2 4000000000\n",
    "negative index of an .obj": OBJ + b"f 1 2 -4000\n",
    "endless number of an .obj": OBJ.replace(b"v 0.", b"v 1e999", 1),
    "cut vertices of an .obj": OBJ[: len(OBJ) // 5],
    "vertices of an .ac": AC3D.replace(b"numvert 3", b"numvert %d" % CLAIM),
    "surfaces of an .ac": AC3D.replace(b"numsurf 1", b"numsurf %d" % CLAIM),
    "corners of an .ac": AC3D.replace(b"refs 3", b"refs %d" % CLAIM),
    "index of an .ac": AC3D.replace(b"2 0 0\nkids", b"7 0 0\nkids"),
    "not finite in an .ac": AC3D.replace(b"0 1 0", b"0 inf 0"),
}


def read_in_little_memory(paths: list[Path], answers) -> None:
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + GIB // 2,) * 2)
    for path in paths:
        try:
            read_mesh(path)
            answers.put("taken")
        except RejectedMesh as rejection:
            answers.put(str(rejection))
        except BaseException as error:
            answers.put(f"{type(error).__name__}: {error}")


def test_every_lie_of_a_file_is_refused_in_a_line_that_names_it_and_costs_no_memory(tmp_path):
    paths = [tmp_path / f"{number}.{name.rpartition('.')[2]}" for number, name in enumerate(LIES)]
    for path, content in zip(paths, LIES.values(), strict=True):
        path.write_bytes(content)
    context = get_context("fork")
    answers = context.SimpleQueue()
    process = context.Process(target=read_in_little_memory, args=(paths, answers))
    process.start()
    for name, path in zip(LIES, paths, strict=True):
        told = answers.get()
        assert told.startswith(("corrupt_file: ", "no_faces: ", "non_finite_vertices: ", "too_large: ")), (
            f"{name}: {told}"
        )
        assert path.name in told and "\n" not in told and "Module" not in told, f"{name}: {told}"
    process.join()


@pytest.mark.parametrize("content", [PLY, ASCII_PLY, STL, ASCII_STL, OFF, OBJ, GLB], ids=range(7))
def test_whole_files_are_taken(content, tmp_path):
    suffix = {PLY: "ply", ASCII_PLY: "ply", STL: "stl", ASCII_STL: "stl", OFF: "off", OBJ: "obj", GLB: "glb"}
    path = tmp_path / f"ball.{suffix[content]}"
    path.write_bytes(content)
    assert len(read_mesh(path)[1]) == len(BALL.faces)


def through_a_file(vertices: np.ndarray, faces: np.ndarray, path: Path):
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (faces + 1).tolist()]
    path.write_text("\n".join(lines))
    return prepare_mesh(read_mesh(path), FEW)


@pytest.mark.parametrize("scale", [1e20, 1e-12, 1.0])
@pytest.mark.parametrize("shift", [0.0, 1e6])
def test_neither_size_nor_place_of_a_file_matters(scale, shift, tmp_path):
    vertices, faces = CHAIR
    samples = through_a_file(vertices * scale + shift * scale, faces, tmp_path / "chair.obj")
    frame = Frame(samples.frame.center / scale - shift, samples.frame.scale * scale)
    right, error = errors(dataclasses.replace(samples, frame=frame), CHAIR)
    assert right >= 0.999 and error < 1e-5


def cube(shift: float) -> tuple[np.ndarray, np.ndarray]:
    return triangles(refined(Manifold.cube([0.5, 0.5, 0.5]).translate([shift] * 3), 0.2))


def joined(*parts):
    first = np.cumsum([0] + [len(vertices) for vertices, _ in parts[:-1]])
    faces = [faces + start for (_, faces), start in zip(parts, first, strict=True)]
    return np.concatenate([vertices for vertices, _ in parts]), np.concatenate(faces)


ODD = {
    "two parts": joined(cube(-1), cube(1)),
    "inside out": (CHAIR[0], CHAIR[1][:, ::-1]),
    "two cubes that share one corner": joined(cube(0), cube(0.5)),
    "a loose fin": joined(
        cube(0), (np.array([[0, 0, 0], [0.5, 0, 0], [0.2, -0.4, -0.4]]), np.array([[0, 1, 2]]))
    ),
    "two cubes that cross": joined(cube(0), cube(0.25)),
}
TRUTH = ODD | {
    "inside out": CHAIR,
    "a loose fin": cube(0),
    "two cubes that cross": triangles(
        Manifold.cube([0.5] * 3) + Manifold.cube([0.5] * 3).translate([0.25] * 3)
    ),
}


@pytest.mark.parametrize("name", ODD)
def test_odd_meshes_have_the_right_inside(name, tmp_path):
    samples = through_a_file(*ODD[name], tmp_path / "odd.obj")
    assert errors(samples, TRUTH[name])[0] >= 0.995


def prepare_large(answers) -> None:
    from benchmarks.large_mesh import bumpy_sphere

    mesh = bumpy_sphere(1600)
    samples = prepare_mesh(mesh, Preparation(samples=100_000))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    answers.put((len(mesh[1]), peak, float((samples.sdf < 0).mean())))


@pytest.mark.slow
def test_five_million_faces_are_prepared_in_bounded_memory():
    answers = get_context("spawn").SimpleQueue()
    process = get_context("spawn").Process(target=prepare_large, args=(answers,))
    process.start()
    faces, peak, inside = answers.get()
    process.join()
    assert faces > 5_000_000 and inside > 0.2
    assert peak < 10 * GIB
