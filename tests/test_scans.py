"""Scans: every format gives the same shape, every broken one a line, and no bound excludes the truth."""

import numpy as np
import pytest
import trimesh

from sdfhub.data.preparation.sampling import normalize_mesh
from sdfhub.errors import SdfhubError
from sdfhub.scans.evidence import Evidence, free_space, is_outside, noise_of, winding
from sdfhub.scans.observed_scan import observe
from sdfhub.scans.scan import Scan, read_scan
from sdfhub.scans.simulated import surface_scan, view_scan
from sdfhub.shapes import NORMALIZED, RADIUS, Frame

EVIDENCE = Evidence(rows=3000, samples=3000, cells=40)
SENSOR = np.array([0.0, -2.4, 0.6])


@pytest.fixture(scope="module")
def box():
    """A closed box, so that distances and normals are known everywhere."""
    mesh = trimesh.creation.box((1.0, 0.6, 1.4)).subdivide().subdivide()
    return normalize_mesh(mesh.vertices, mesh.faces)


def true_sdf(box, points):
    half = box.vertices.max(axis=0)
    apart = np.abs(points) - half
    return np.linalg.norm(np.maximum(apart, 0), axis=1) + np.minimum(apart.max(axis=1), 0)


def cloud(box, count=3000, noise=0.0, seed=0):
    return surface_scan(box, count, noise, np.random.default_rng(seed))


def excluded(box, observation) -> np.ndarray:
    """How far the truth lies outside the bounds."""
    truth = true_sdf(box, observation.points.astype(np.float64))
    truth = np.where(observation.unsigned, np.abs(truth), truth)
    return np.maximum(np.maximum(observation.low - truth, truth - observation.high), 0)


@pytest.mark.parametrize("with_normals", [True, False])
@pytest.mark.parametrize("noise", [0.005, 0.01])
@pytest.mark.parametrize("count", [1000, 8000])
def test_gaps_between_noisy_points_are_bare_of_evidence(box, with_normals, noise, count):
    points, normals = cloud(box, count, noise)
    rng = np.random.default_rng(1)
    seen = EVIDENCE.of_cloud(points, normals if with_normals else None, rng)
    bounded = seen.low != seen.high  # the rest lies on the surface, but for the noise
    assert np.mean(excluded(box, seen)[bounded] > 0.01) < 0.02


@pytest.mark.parametrize("with_normals", [True, False])
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_bounds_around_a_cloud_hold_the_truth(box, with_normals, noise):
    points, normals = cloud(box, noise=noise)
    rng = np.random.default_rng(1)
    seen = EVIDENCE.of_cloud(points, normals if with_normals else None, rng)
    wrong = excluded(box, seen)
    assert len(seen.points) == EVIDENCE.rows
    assert np.mean(wrong > 0.004 + 2 * noise) < 0.03
    assert np.mean(seen.high - seen.low) < 0.03 + 4 * noise, "they say something"
    known = ~seen.unsigned & (seen.low > 0.03)
    assert known.mean() > 0.1
    if with_normals:
        assert (seen.high < 0).mean() > 0.1, "normals tell the inside"


def test_bounds_of_a_view_hold_the_truth_behind_it(box):
    rng = np.random.default_rng(0)
    points = view_scan(box, SENSOR, 60, 0.0, rng)
    assert np.abs(true_sdf(box, points)).max() < 1e-5
    assert points[:, 1].max() < box.vertices[:, 1].max() - 0.05, "the far side is not seen"
    seen = EVIDENCE.of_view(points, None, SENSOR, rng)
    assert np.mean(excluded(box, seen) > 0.005) < 0.02
    assert (seen.low > 0.05).mean() > 0.02, "free space keeps surfaces away"


@pytest.mark.parametrize("background", [True, False])
def test_free_space_is_never_nearer_to_a_surface_than_it_says(box, background):
    points = view_scan(box, SENSOR, 60, 0.0, np.random.default_rng(0))
    empty, clear = free_space(points, SENSOR, 40, background)
    assert (true_sdf(box, empty) >= clear - 1e-6).all()
    beside = np.abs(empty[:, 0]) > box.vertices[:, 0].max() + 0.1
    assert beside.any() == background


def test_noise_is_measured_and_none_is_none(box):
    for noise in (0.005, 0.01, 0.02):
        assert noise_of(cloud(box, 6000, noise)[0]) == pytest.approx(noise, rel=0.35)
    assert noise_of(cloud(box, 6000)[0]) < 1e-3


def test_only_what_can_be_reached_is_outside(box):
    points, _ = cloud(box, 6000)
    at = np.random.default_rng(0).uniform(-1, 1, (500, 3))
    truth = true_sdf(box, at)
    found = is_outside(points, at, 0.08, 40)
    assert found[truth > 0.2].all() and not found[truth < 0].any()


def test_the_winding_number_of_a_cloud_is_one_inside(box):
    points, normals = cloud(box, 4000)
    at = np.random.default_rng(0).uniform(-0.9, 0.9, (300, 3))
    clear = np.abs(true_sdf(box, at)) > 0.1
    turns = winding(points, normals, at)
    assert np.abs(turns - (true_sdf(box, at) < 0))[clear].max() < 0.1


def formats(folder, points, normals):
    """The same oriented cloud in every format."""
    rows = np.hstack([points, normals])
    np.savetxt(folder / "a.xyz", rows)
    np.save(folder / "a.npy", rows)
    np.savez(folder / "a.npz", points=points, normals=normals)
    names = ["x", "y", "z", "nx", "ny", "nz"]
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    head += [f"property float {name}" for name in names] + ["end_header\n"]
    (folder / "a.ply").write_bytes("\n".join(head).encode() + rows.astype("<f4").tobytes())
    return [folder / f"a.{suffix}" for suffix in ("xyz", "npy", "npz", "ply")]


def test_every_format_gives_the_same_cloud(box, tmp_path):
    points, normals = cloud(box, 200)
    for path in formats(tmp_path, points, normals):
        scan = read_scan(path)
        assert scan.kind == "oriented"
        assert np.allclose(scan.points, points, atol=1e-6) and np.allclose(scan.normals, normals, atol=1e-6)


def test_what_a_file_is_follows_from_what_it_holds(box, tmp_path):
    points, _ = cloud(box, 200)
    trimesh.PointCloud(points).export(tmp_path / "bare.ply")
    trimesh.Trimesh(box.vertices, box.faces, process=False).export(tmp_path / "mesh.ply")
    np.savez(tmp_path / "view.npz", points=points, sensor=SENSOR)
    at = np.random.default_rng(0).uniform(-1, 1, (500, 3))
    np.savez(tmp_path / "samples.npz", points=at, sdf=true_sdf(box, at))
    rows = np.column_stack([at, true_sdf(box, at)]).astype(np.float32)
    np.savez(tmp_path / "deepsdf.npz", pos=rows[rows[:, 3] >= 0], neg=rows[rows[:, 3] < 0])
    kinds = {path.stem: read_scan(path).kind for path in tmp_path.iterdir()}
    wanted = {name: name for name in ("bare", "mesh", "view", "samples")}
    assert kinds == wanted | {"deepsdf": "samples"}


def test_the_shapes_own_box_undoes_any_units(box):
    points, normals = cloud(box)
    far = points * 700 + [1e4, 0, -3e3]
    rng = [np.random.default_rng(0) for _ in range(2)]
    here, there = (
        observe(Scan(at, normals), EVIDENCE, "shape", each) for at, each in ((points, rng[0]), (far, rng[1]))
    )
    assert np.allclose(here.observation.points, there.observation.points, atol=1e-4)
    corner = np.linalg.norm(there.frame.to_normalized(far), axis=1).max()
    assert corner == pytest.approx(RADIUS)


def test_a_mesh_becomes_its_own_samples(box):
    source = box.vertices * 3 + 1
    target = observe(Scan(source, faces=box.faces), EVIDENCE, "shape", np.random.default_rng(0))
    assert target.kind == "samples" and excluded(box, target.observation).max() < 1e-3
    assert np.allclose(target.frame.to_source(box.vertices), source, atol=1e-6)


WRONG = {
    "nan.npy": "1 numbers of its points are not finite",
    "three.npy": "3 points; at least 50",
    "columns.npy": "expected rows x y z",
    "objects.npy": "objects",
    "empty.ply": "cannot be read as ply",
    "text.ply": "cannot be read as ply",
    "cut.ply": "cut off or damaged",
    "words.xyz": "could not convert",
    "cut.npz": "not a zip file",
    "keys.npz": "holds vertices; expected",
    "no_faces.obj": "no faces",
    "chair.docx": "not a format",
    "one_side.npz": "both sides",
}


def write_broken(path, points):
    """A file that is wrong in the way its name says."""
    bad = points.copy()
    bad[3, 1] = np.nan
    arrays = {"nan": bad, "three": points[:3], "columns": points[:, :2]}
    arrays["objects"] = np.array([{}], dtype=object)
    archives = {"keys": {"vertices": points}, "one_side": {"points": points, "sdf": np.ones(len(points))}}
    texts = {"empty": "", "text": "a chair\n", "words": "a b c\n", "no_faces": "v 0 0 0\nv 1 0 0\n"}
    if path.name == "cut.ply":
        path.write_bytes(trimesh.PointCloud(points).export(file_type="ply")[:900])
    elif path.stem in arrays:
        np.save(path, arrays[path.stem], allow_pickle=True)
    elif path.stem in archives:
        np.savez(path, **archives[path.stem])
    else:
        path.write_text(texts.get(path.stem, "PK\x03\x04 and no more"))


@pytest.mark.parametrize("name", WRONG)
def test_a_broken_file_is_one_line_that_names_it(box, tmp_path, name):
    write_broken(tmp_path / name, cloud(box, 200)[0])
    with pytest.raises(SdfhubError) as stop:
        read_scan(tmp_path / name)
    assert WRONG[name] in str(stop.value) and name in str(stop.value)
    assert "\n" not in str(stop.value)


@pytest.mark.parametrize(
    ("points", "sensor", "frame", "words"),
    [
        (500.0, None, NORMALIZED, "frame=shape"),
        (0.01, None, NORMALIZED, "frame=shape"),
        ([1.0, 1.0, 0.0], None, "shape", "extents"),
        (1.0, SENSOR, "shape", "frame=unknown"),
    ],
)
def test_a_scan_that_does_not_fit_its_frame_says_what_would(box, points, sensor, frame, words):
    scan = Scan(cloud(box, 200)[0] * points, sensor=sensor)
    with pytest.raises(SdfhubError, match=words):
        observe(scan, EVIDENCE, frame, np.random.default_rng(0))


def test_a_mesh_that_does_not_fit_its_frame_hears_of_meshes(box):
    scan = Scan(box.vertices * 500, faces=box.faces)
    with pytest.raises(SdfhubError, match="reaches .* give frame=shape if it is whole"):
        observe(scan, EVIDENCE, NORMALIZED, np.random.default_rng(0))


@pytest.mark.parametrize("count", [4096, 65_536])
def test_the_outside_does_not_leak_into_a_dense_cloud_nor_into_one_whose_points_come_twice(count):
    """Points of a sphere's surface closer together than the flood's cells, or each given twice."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(count, 3))
    points *= 0.8 / np.linalg.norm(points, axis=1, keepdims=True)
    twice = np.repeat(points[: count // 2], 2, axis=0)
    for cloud in (points, twice):
        target = observe(Scan(cloud), EVIDENCE, NORMALIZED, np.random.default_rng(1))
        seen = target.observation
        inside = np.linalg.norm(seen.points, axis=1) < 0.7
        assert inside.sum() > 50 and seen.unsigned[inside].all(), "none is surely outside"


def test_inside_and_outside_of_a_cloud_whose_gaps_reach_the_corners():
    points = np.array(trimesh.creation.icosphere(2).vertices) * 0.97
    assert not is_outside(points, np.zeros((1, 3)), 1.34, 24).any()


def test_shares_that_leave_no_row_leave_none(box):
    half = Evidence(4095, surface=0.5, uniform=0.5, variances=(0.01,))
    assert len(half.of_cloud(cloud(box, 500)[0], None, np.random.default_rng(0)).points) == 4095


def test_a_cloud_of_few_different_points_is_refused():
    points = np.repeat(np.random.default_rng(0).uniform(-1, 1, (30, 3)), 3, axis=0)
    with pytest.raises(SdfhubError, match="30 different points"):
        observe(Scan(points), EVIDENCE, "shape", np.random.default_rng(0))


def test_normals_of_any_length_are_directions():
    points = np.random.default_rng(0).normal(size=(60, 3))
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    np.testing.assert_allclose(Scan(points, 5 * normals).normals, normals)


@pytest.mark.parametrize(
    "part", [{"center": np.zeros((1, 3))}, {"center": np.full(3, np.nan)}, {"scale": np.zeros(1)}]
)
def test_a_frame_that_is_none_is_refused(part, tmp_path):
    points = np.random.default_rng(0).uniform(-1, 1, (60, 3))
    np.savez(tmp_path / "a.npz", points=points, sdf=points[:, 0], **part)
    with pytest.raises(SdfhubError, match=r"a.npz: .*" + next(iter(part))):
        read_scan(tmp_path / "a.npz")


@pytest.mark.parametrize("kind", ["cloud", "mesh", "samples", "view"])
def test_a_scan_in_the_frame_of_a_known_source_is_what_it_is_in_the_normalised_frame(box, kind):
    frame = Frame(np.array([3.0, -1.0, 2.0]), 0.25)
    rng = np.random.default_rng(0)
    at = rng.uniform(-1, 1, (4000, 3))
    made = {
        "cloud": lambda move, size: Scan(move(cloud(box)[0])),
        "mesh": lambda move, size: Scan(move(box.vertices), faces=box.faces),
        "samples": lambda move, size: Scan(move(at), sdf=size * true_sdf(box, at)),
        "view": lambda move, size: Scan(
            move(view_scan(box, SENSOR, 60, 0.0, np.random.default_rng(0))), sensor=move(SENSOR)
        ),
    }[kind]
    here = observe(made(lambda points: points, 1.0), EVIDENCE, NORMALIZED, np.random.default_rng(1))
    there = observe(made(frame.to_source, 4.0), EVIDENCE, frame, np.random.default_rng(1))
    assert np.abs(here.observation.points - there.observation.points).max() < 1e-5
    assert np.abs(here.observation.high - there.observation.high).max() < 1e-3
    np.testing.assert_allclose(there.frame.to_source(box.vertices), frame.to_source(box.vertices))


def test_a_cut_cloud_in_text_is_refused(tmp_path, box):
    whole = trimesh.PointCloud(cloud(box, 200)[0]).export(file_type="ply", encoding="ascii")
    (tmp_path / "cut.ply").write_bytes(b"\n".join(whole.splitlines()[:100]) + b"\n")
    with pytest.raises(SdfhubError, match="cut off or damaged"):
        read_scan(tmp_path / "cut.ply")
