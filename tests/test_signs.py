import igl
import numpy as np
import pytest
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from manifold3d import Manifold, OpType

from sdfhub.data.preparation.sampling import normalize_mesh, sample_points
from sdfhub.data.preparation.settings import Preparation
from sdfhub.data.preparation.signs import ROOM, SIGN_METHODS, cut_long, nearest_points, winding_signs
from sdfhub.data.preparation.visibility import closed_surface, sightings, visible_surface
from sdfhub.geometry.morton import morton_order
from sdfhub.geometry.surface import face_normals, points_on_faces, sphere_directions
from sdfhub.geometry.triangle_tree import TriangleTree
from tests.broken_twins import chair_parts, punctured, refined, ring, signed_distance, triangles

CHAIR = triangles(refined(Manifold.batch_boolean(chair_parts(), OpType.Add)))


def surface_and_points(mesh, count=20_000, closed=False):
    normalized = normalize_mesh(*mesh)
    rng = np.random.default_rng(0)
    surface = closed_surface(normalized) if closed else visible_surface(normalized, Preparation(), rng)
    return surface, sample_points(surface, Preparation(samples=count), rng)


@pytest.mark.parametrize("mesh", [CHAIR, triangles(ring())], ids=["chair", "ring"])
def test_fast_path_equals_the_winding_path_on_clean_meshes(mesh):
    surface, points = surface_and_points(mesh, closed=True)
    nearest, rng = nearest_points(points, surface), np.random.default_rng(0)
    fast = SIGN_METHODS["pseudo_normal"](points, nearest, surface, rng)
    slow = SIGN_METHODS["winding"](points, nearest, surface, rng)
    np.testing.assert_array_equal(fast.inside, slow.inside)


def test_winding_numbers_shared_within_empty_balls_equal_those_of_every_point():
    import igl

    mesh = punctured(CHAIR, np.random.default_rng(0))
    surface, points = surface_and_points(mesh)
    signs = winding_signs(points, nearest_points(points, surface), surface, np.random.default_rng(0))
    every = igl.fast_winding_number(surface.vertices, surface.solid(), points)
    assert np.mean(signs.inside != (every > 0.5)) < 1e-4


@pytest.mark.parametrize("method", SIGN_METHODS)
def test_signs_do_not_depend_on_the_order_of_the_points(method):
    surface, points = surface_and_points(CHAIR, 3000)
    shuffle = np.random.default_rng(1).permutation(len(points))
    sign = SIGN_METHODS[method]
    one = sign(points, nearest_points(points, surface), surface, np.random.default_rng(0))
    other = sign(points[shuffle], nearest_points(points[shuffle], surface), surface, np.random.default_rng(0))
    np.testing.assert_array_equal(one.inside[shuffle], other.inside)


@pytest.mark.parametrize("count", [1, 2, 7])
def test_few_points_are_signed_too(count):
    surface, points = surface_and_points(CHAIR, 50)
    signs = winding_signs(
        points[:count], nearest_points(points[:count], surface), surface, np.random.default_rng(0)
    )
    truth = signed_distance((surface.vertices, surface.faces), points[:count]) < 0
    np.testing.assert_array_equal(signs.inside, truth)


def test_morton_order_keeps_neighbours_together():
    points = np.random.default_rng(0).uniform(-1, 1, (4096, 3))
    order = morton_order(points)
    assert sorted(order) == list(range(4096))
    steps = np.linalg.norm(np.diff(points[order], axis=0), axis=1)
    assert steps.mean() < 0.25 * np.linalg.norm(np.diff(points, axis=0), axis=1).mean()


def test_hidden_faces_go_and_flipped_ones_turn():
    shell = triangles(refined(Manifold.sphere(1, 48), 0.2))
    inner = triangles(Manifold.sphere(0.5, 32))
    vertices = np.concatenate([shell[0], inner[0]])
    faces = np.concatenate([shell[1][:, ::-1], inner[1] + len(shell[0])])
    surface = visible_surface(normalize_mesh(vertices, faces), Preparation(), np.random.default_rng(0))
    assert len(surface.faces) == len(shell[1])
    corners = surface.vertices[surface.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.einsum("nj,nj->n", normals, corners.mean(axis=1)) > 0).all()
    assert not surface.two_sided.any()


def test_cut_faces_are_the_same_surface_in_shorter_pieces():
    vertices, faces = triangles(Manifold.batch_boolean(chair_parts(), OpType.Add))
    points, rows = cut_long(vertices, faces, 0.2)
    corners, given = points[rows], vertices[faces]
    source = TriangleTree(given).nearest(corners.mean(axis=1))[1]
    assert np.linalg.norm(np.roll(corners, 1, axis=1) - corners, axis=2).max() <= 0.2
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    whole = np.cross(given[:, 1] - given[:, 0], given[:, 2] - given[:, 0])
    total = np.stack([np.bincount(source, axis) for axis in normals.T], axis=1)
    np.testing.assert_allclose(total, whole, atol=1e-12)  # areas and sides of the pieces add up
    direction = whole / np.linalg.norm(whole, axis=1)[:, None]
    offset = np.einsum("nij,nj->ni", corners - given[source, :1], direction[source])
    np.testing.assert_allclose(offset, 0, atol=1e-12)


def test_cutting_stops_before_it_fills_memory():
    corners = np.random.default_rng(0).uniform(-1, 1, (1000, 3))
    faces = np.random.default_rng(1).integers(0, 1000, (40_000, 3))
    assert len(cut_long(corners, faces, 0.01)[1]) <= len(faces) + ROOM


def soup(kind: str) -> np.ndarray:
    """Triangles [F, 3, 3]: of a chair, anywhere, long and thin, or without area."""
    if kind == "chair":
        vertices, faces = triangles(Manifold.batch_boolean(chair_parts(), OpType.Add))
        return vertices[faces]
    corners = np.random.default_rng(0).uniform(-1, 1, (1 if kind == "one" else 301, 3, 3))
    if kind == "thin":
        corners[:, 2] = corners[:, 1] + 1e-7 * corners[:, 2]
    if kind == "empty":
        corners[::3, 2] = corners[::3, 0]
        corners[1::3] = corners[1::3, :1]
        corners[2::3, 2] = 2 * corners[2::3, 1] - corners[2::3, 0]
    return corners


def to_segments(points: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """[N] distances to the nearest of the segments from a [F, 3] to b [F, 3]."""
    along, apart = b - a, points[:, None] - a
    share = np.sum(apart * along, axis=2) / np.maximum(np.sum(along**2, axis=1), 1e-300)
    return np.linalg.norm(apart - share.clip(0, 1)[..., None] * along, axis=2).min(axis=1)


@pytest.mark.parametrize("kind", ["chair", "one", "anywhere", "thin", "empty"])
def test_the_tree_finds_what_libigl_finds(kind):
    corners, points = soup(kind), np.random.default_rng(1).uniform(-1.2, 1.2, (3000, 3))
    points[::10] = corners[np.arange(300) % len(corners), 0]
    distance, row, foot = TriangleTree(corners).nearest(points)
    if kind == "empty":  # where libigl is wrong
        wanted = np.min([to_segments(points, corners[:, i], corners[:, i - 1]) for i in range(3)], axis=0)
    else:
        vertices, faces = corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3)
        wanted = np.sqrt(igl.point_mesh_squared_distance(points, vertices, faces)[0])
    np.testing.assert_allclose(distance, wanted, atol=2e-7 if kind == "thin" else 1e-14)
    np.testing.assert_allclose(np.linalg.norm(points - foot, axis=1), distance, atol=1e-15)
    alone = [TriangleTree(corners[[r]]).nearest(points[[i]])[0][0] for i, r in enumerate(row)]
    assert np.array_equal(alone, distance)


def test_rays_from_the_faces_see_what_rays_at_the_faces_see():
    mesh = normalize_mesh(*punctured(CHAIR, np.random.default_rng(0)))
    seen, rng = sightings(mesh, 100, np.random.default_rng(0)), np.random.default_rng(1)
    scene = EmbreeScene()
    TriangleMesh(scene, mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32))
    directions, normals = sphere_directions(400), face_normals(mesh.vertices, mesh.faces)
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    sums = np.zeros((2, len(mesh.faces)))
    face = np.arange(len(mesh.faces))
    for direction in directions:
        origins = points_on_faces(mesh.vertices[mesh.faces], face, rng) + 2.5 * direction
        towards = np.broadcast_to(-direction, origins.shape)
        hit = scene.run(origins.astype(np.float32), towards.astype(np.float32), output=True)
        cosine = normals @ direction * (hit["primID"] == face)
        sums += np.maximum([cosine, -cosine], 0)
    plain = sums / np.abs(normals @ directions.T).sum(axis=1)
    area = np.linalg.norm(face_normals(mesh.vertices, mesh.faces), axis=1)
    for few, many in zip(seen, plain, strict=True):
        assert np.average(few - many, weights=area) == pytest.approx(0, abs=0.01)
        assert np.average(np.abs(few - many), weights=area) < 0.08
    is_kept, is_kept_plain = seen.sum(axis=0) > 0.04, plain.sum(axis=0) > 0.04
    assert np.average(is_kept != is_kept_plain, weights=area) < 0.01
