"""The coarse-to-fine mesh is the dense one; both lie where the field says, and face outward."""

import numpy as np
import pytest
import torch
from dense_meshing import mesh_dense
from scipy.spatial import cKDTree

from sdfhub.errors import SdfhubError
from sdfhub.geometry import coarse_to_fine, mesher
from sdfhub.geometry.coarse_to_fine import SampledCells, sample_blocks
from sdfhub.geometry.grid import Grid
from sdfhub.geometry.mesher import mesh_field, mesh_fields, sdf_slice
from sdfhub.geometry.metrics import is_closed

RADIUS = 0.6


def sphere(points):
    return points.norm(dim=-1) - RADIUS


def torus(points):
    return torch.hypot(torch.hypot(points[:, 0], points[:, 1]) - 0.6, points[:, 2]) - 0.1


def box(points, centre, half):
    q = (points - torch.tensor(centre)).abs() - torch.tensor(half)
    return q.clamp(min=0).norm(dim=-1) + q.max(dim=-1).values.clamp(max=0)


def boxes(points):
    seat = box(points, (0.0, 0.0, 0.0), (0.5, 0.5, 0.05))
    legs = [box(points, (x, 0.4, -0.4), (0.03, 0.02, 0.4)) for x in (-0.4, 0.4)]
    return torch.stack([seat, *legs]).amin(dim=0)


def rod(points, start, end):
    start, end = torch.tensor(start), torch.tensor(end)
    along = ((points - start) @ (end - start) / (end - start).square().sum()).clamp(0, 1)
    return (points - start - along[:, None] * (end - start)).norm(dim=-1) - 0.01


def rods(points):
    first = rod(points, (-0.5, -0.5, -0.7), (0.5, 0.6, 0.8))
    return torch.minimum(first, rod(points, (0.5, -0.5, -0.7), (-0.3, 0.6, 0.8)))


def spheres_apart(points):
    """Tiny spheres far from each other: what a coarse level may lose."""
    centres = torch.tensor([[0.7, 0.7, 0.7], [-0.61, 0.13, 0.27], [0.05, -0.72, -0.33]])
    return (points[:, None] - centres).norm(dim=-1).amin(dim=1) - 0.012


def sheet(points):
    """A leaning square, thinner than a step of the coarsest level by far."""
    leaning = torch.stack([points[:, 0], points[:, 1] - 0.3 * points[:, 0], points[:, 2]], dim=1)
    return box(leaning, (0.1, 0.05, 0.0), (0.6, 0.018, 0.6))


def clamped_rods(points):
    return rods(points).clamp(-0.1, 0.1)


def flat_rods(points):
    return 0.01 * rods(points)


class Waves(torch.nn.Module):
    """A small random network of sines, or of HOSC, with no likeness to a distance."""

    def __init__(self, seed, hosc=False):
        super().__init__()
        generator = torch.Generator().manual_seed(seed)

        def uniform(*shape, scale):
            return torch.nn.Parameter((2 * torch.rand(*shape, generator=generator) - 1) * scale)

        self.first, self.hidden = uniform(3, 32, scale=1 / 3), uniform(32, 32, scale=0.25)
        self.last, self.hosc = uniform(32, scale=0.1), hosc

    def forward(self, points):
        x = torch.sin(10 * points @ self.first)
        x = torch.sin(3 * x @ self.hidden)
        return (torch.tanh(2 * x) if self.hosc else x) @ self.last + 0.05


class Counted:
    def __init__(self, field):
        self.field, self.count = field, 0

    def __call__(self, points):
        self.count += len(points)
        return self.field(points)


FIELDS = {
    "sphere": sphere,
    "torus": torus,
    "boxes": boxes,
    "rods": rods,
    "sheet": sheet,
    "clamped_rods": clamped_rods,
    "flat_rods": flat_rods,
    "spheres_apart": spheres_apart,
    "siren": Waves(0),
    "hosc": Waves(1, hosc=True),
}


def assert_same_mesh(have, want):
    assert len(have[0]) == len(want[0]) and len(have[1]) == len(want[1])
    # a node where the field is exactly 0 carries several vertices: compare places
    places, row = np.unique(want[0], axis=0, return_inverse=True)
    distance, partner = cKDTree(places).query(have[0])
    assert distance.max(initial=0) < 1e-6
    corners = np.sort(partner[have[1]], axis=1), np.sort(row.reshape(-1)[want[1]], axis=1)
    assert np.array_equal(*(np.sort(c @ [1, 10**6, 10**12]) for c in corners))


@pytest.mark.parametrize("name", FIELDS)
@pytest.mark.parametrize("resolution", [64, 97])
def test_coarse_to_fine_equals_dense(name, resolution, monkeypatch):
    monkeypatch.setattr(coarse_to_fine, "COARSE", 16)
    field = FIELDS[name]
    want = mesh_dense(field, resolution)
    assert len(want[0])
    assert_same_mesh(mesh_field(field, resolution), want)


FAMILY = [rods, lambda points: sphere(points) + 5, Waves(0), spheres_apart, torus]


class Family:
    """Shapes that need unequal numbers of points, one of them without a surface; notes its calls."""

    def __init__(self):
        self.calls = []

    def __call__(self, points, shapes):
        self.calls.append((points.shape[0] * points.shape[1], shapes.tolist()))
        rows = [FAMILY[shape](own) for own, shape in zip(points, shapes.tolist(), strict=True)]
        return torch.stack(rows)


def test_shapes_meshed_together_are_those_meshed_alone():
    together = list(mesh_fields(Family(), len(FAMILY), 64, batch=2**14))
    assert len(together) == len(FAMILY) and not len(together[1][0])
    for have, field in zip(together, FAMILY, strict=True):
        vertices, faces = mesh_field(field, 64)
        assert np.abs(have[0] - vertices).max(initial=0) < 1e-6
        assert np.array_equal(have[1], faces)


def test_shapes_together_share_their_calls():
    family = Family()
    list(mesh_fields(family, len(FAMILY), 64, batch=2**30))
    assert set(family.calls[0][1]) == set(range(len(FAMILY)))
    alone = []
    for row in range(len(FAMILY)):
        single = Family()
        list(mesh_fields(lambda points, shapes, f=single, r=row: f(points, shapes + r), 1, 64, batch=2**30))
        alone.append(len(single.calls))
    assert len(family.calls) == max(alone)


def test_memory_bounds_groups_and_calls(monkeypatch):
    monkeypatch.setattr(mesher, "_NODES_TOGETHER", 2 * 40**3)
    family = Family()
    meshes = mesh_fields(family, len(FAMILY), 40, batch=3000)
    next(meshes)
    assert {shape for _, shapes in family.calls for shape in shapes} == {0, 1}
    assert len(list(meshes)) == len(FAMILY) - 1
    assert max(points for points, _ in family.calls) <= 3000


def test_a_piece_seen_in_one_block_is_followed_to_its_end(monkeypatch):
    want = mesh_dense(torus, 96)
    index = (want[0][0] + 1) * 95 / 2
    seen = np.array([[0, *(index // 2).astype(int)]])
    centre = torch.from_numpy((2 * seen[:, 1:] + 1) * 2 / 95 - 1).float()
    sampled = SampledCells(seen, torus(centre).numpy(), np.array([np.inf]))
    monkeypatch.setattr(mesher, "sample_blocks", lambda *_: sampled)
    assert_same_mesh(mesh_field(torus, 96), want)


@pytest.mark.parametrize("field", [torus, Waves(0)])
def test_signs_inferred_wrongly_are_corrected(field, monkeypatch):
    def too_sure(grid):
        sampled = sample_blocks(grid)
        return sampled._replace(slope=0.2 * sampled.slope)

    monkeypatch.setattr(mesher, "sample_blocks", too_sure)
    assert_same_mesh(mesh_field(field, 96), mesh_dense(field, 96))


def test_a_chair_like_field_needs_few_evaluations():
    field = Counted(boxes)
    mesh_field(field, 256)
    assert field.count < 0.02 * 256**3


def test_vertices_lie_on_the_surface():
    vertices, faces = mesh_field(sphere, 64)
    assert vertices.dtype == np.float64 and faces.dtype == np.int64
    step = 2 / 63  # linear interpolation of a sphere is off by about step^2 / (8 R)
    assert np.abs(np.linalg.norm(vertices, axis=1) - RADIUS).max() < step**2 / RADIUS
    assert np.abs(vertices.mean(axis=0)).max() < 1e-3


def test_the_grid_includes_both_end_points():
    seen = []

    def field(points):
        seen.append(points)
        return sphere(points)

    mesh_dense(field, 17)
    points = torch.cat(seen)
    assert points.dtype == torch.float32
    assert torch.allclose(points.amin(0), torch.tensor(-1.0))
    assert torch.allclose(points.amax(0), torch.tensor(1.0))
    assert len(points[:, 0].unique()) == 17
    assert torch.allclose(points[:, 0].unique().diff(), torch.tensor(2 / 16), atol=1e-6)


def test_a_plane_is_found_exactly_where_it_is():
    vertices, _ = mesh_field(lambda p: p[:, 0] - 0.123, 50)
    assert np.abs(vertices[:, 0] - 0.123).max() < 1e-6


@pytest.mark.parametrize("name", ["sphere", "torus", "boxes", "rods"])
def test_faces_look_outward_and_close(name):
    vertices, faces = mesh_field(FIELDS[name], 96)
    assert is_closed(vertices, faces)
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    assert np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6 > 0


@pytest.mark.parametrize("mesh", [mesh_dense, mesh_field])
@pytest.mark.parametrize("shift", [5.0, -5.0])
def test_no_zero_crossing_is_an_empty_mesh(mesh, shift):
    vertices, faces = mesh(lambda p: sphere(p) + shift, 40)
    assert vertices.shape == (0, 3) and faces.shape == (0, 3)
    assert vertices.dtype == np.float64 and faces.dtype == np.int64


def test_a_constant_field_is_an_empty_mesh():
    for value in (0.0, 1.0):
        assert len(mesh_field(lambda p, v=value: torch.full((len(p),), v), 40)[0]) == 0


def test_a_field_that_is_not_finite_is_one_clear_line():
    with pytest.raises(SdfhubError, match="not finite"):
        mesh_field(lambda p: p[:, 0] / 0, 40)


def test_a_field_of_the_wrong_shape_is_refused():
    with pytest.raises(ValueError, match="expected"):
        mesh_field(lambda p: p, 40)


def test_meshing_leaves_no_gradients():
    network = Waves(0)
    states = []

    def field(points):
        values = network(points)
        states.append(values.requires_grad)
        return values

    mesh_field(field, 24)
    assert states and not any(states)


@pytest.mark.parametrize("resolution", [2, 3, 17, 18, 33])
def test_any_resolution_works(resolution):
    def corner(points):  # near a corner of the cube: the smallest grid crosses it too
        return (points - 1).norm(dim=-1) - 0.9

    want = mesh_dense(corner, resolution)
    assert len(want[0])
    assert_same_mesh(mesh_field(corner, resolution), want)


def test_a_slice_keeps_the_order_of_its_axes():
    values = sdf_slice(lambda p: p[:, 0] + 10 * p[:, 2] + 100 * p[:, 1], axis=1, offset=0.25, resolution=33)
    assert values.shape == (33, 33)
    assert values[0, -1] == pytest.approx(25 - 1 + 10, abs=1e-4)  # x = -1, z = 1
    assert values[-1, 0] == pytest.approx(25 + 1 - 10, abs=1e-4)  # x = 1, z = -1


def test_nodes_beyond_two_thousand_million_lie_where_they_are():
    """Keys of a grid of 1300 points an axis do not fit 32 bits."""
    grid = Grid(lambda points, shapes: points[..., 0], range(1), 1300, 4096, torch.device("cpu"))
    assert grid.evaluate(np.array([0, 1300**3 - 1], np.int64)).tolist() == [-1, 1]
