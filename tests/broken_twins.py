"""Closed shapes broken in known ways, and the truth that their clean twins keep."""

from collections.abc import Callable

import igl
import manifold3d
import numpy as np

from sdfhub.shapes import Mesh, ShapeSamples


def triangles(solid: manifold3d.Manifold) -> Mesh:
    """Vertices [V, 3] float64 and faces [F, 3] int64 of a solid."""
    mesh = solid.to_mesh64()
    return np.array(mesh.vert_properties[:, :3], np.float64), np.array(mesh.tri_verts, np.int64)


def chair_parts(seed: int = 0) -> list[manifold3d.Manifold]:
    """Overlapping closed parts of a chair: seat, legs, back, an arm of round section."""
    rng = np.random.default_rng(seed)
    width, thick, leg = rng.uniform(0.7, 1.1), rng.uniform(0.04, 0.12), rng.uniform(0.02, 0.05)
    box = manifold3d.Manifold.cube
    parts = [box([width, 0.8, thick], True), box([width, 0.06, 0.9], True).translate([0, 0.37, 0.4])]
    for x in (-1, 1):
        for y in (-0.34, 0.34):
            parts.append(
                manifold3d.Manifold.cylinder(0.8, leg, leg * 0.7, 24).translate([x * width * 0.44, y, -0.8])
            )
    arm = manifold3d.Manifold.cylinder(0.75, 0.03, 0.03, 24).rotate([90, 0, 0])
    return [*parts, arm.translate([width * 0.47, 0.37, 0.3])]


def ring() -> manifold3d.Manifold:
    """A torus: curved everywhere, with a hole."""
    circle = manifold3d.CrossSection.circle(0.25, 48).translate([0.7, 0])
    return manifold3d.Manifold.revolve(circle, 64)


def refined(solid: manifold3d.Manifold, edge: float = 0.15) -> manifold3d.Manifold:
    """The same solid in smaller triangles, so that a lost one leaves a small hole."""
    return solid.refine_to_length(edge)


def flipped(mesh: Mesh, rng: np.random.Generator) -> Mesh:
    """Half of the faces turned inside out."""
    vertices, faces = mesh
    return vertices, np.where(rng.random(len(faces))[:, None] < 0.5, faces[:, ::-1], faces)


def punctured(mesh: Mesh, rng: np.random.Generator) -> Mesh:
    """2% of the faces gone."""
    vertices, faces = mesh
    return vertices, faces[rng.random(len(faces)) >= 0.02]


def duplicated(mesh: Mesh, rng: np.random.Generator) -> Mesh:
    """10% of the faces twice."""
    vertices, faces = mesh
    return vertices, np.concatenate([faces, faces[rng.random(len(faces)) < 0.1]])


def with_inner_shell(mesh: Mesh, rng: np.random.Generator) -> Mesh:
    """A stray ball, inside out, where the shape is thickest."""
    vertices, faces = mesh
    points = rng.uniform(vertices.min(axis=0), vertices.max(axis=0), (20_000, 3))
    depth = -signed_distance(mesh, points)
    ball = manifold3d.Manifold.sphere(0.6 * depth.max(), 16).translate(points[depth.argmax()])
    more, shell = triangles(ball)
    return np.concatenate([vertices, more]), np.concatenate([faces, shell[:, ::-1] + len(vertices)])


def all_of_it(mesh: Mesh, rng: np.random.Generator) -> Mesh:
    """Every breakage at once."""
    for broken in (with_inner_shell, punctured, duplicated, flipped):
        mesh = broken(mesh, rng)
    return mesh


BREAKAGES: dict[str, Callable[[Mesh, np.random.Generator], Mesh]] = {
    "half the faces flipped": flipped,
    "2% of faces deleted": punctured,
    "10% duplicated": duplicated,
    "stray inner shell": with_inner_shell,
    "all of it": all_of_it,
}


def signed_distance(clean: Mesh, points: np.ndarray) -> np.ndarray:
    """[N] exact signed distances to a clean closed mesh, negative inside; signs by its winding number."""
    tree = igl.AABB()
    tree.init(*clean)
    distance = np.sqrt(tree.squared_distance(*clean, points)[0])
    return np.where(igl.fast_winding_number(*clean, points) > 0.5, -distance, distance)


def errors(samples: ShapeSamples, clean: Mesh, count: int = 20_000) -> tuple[float, float]:
    """Share of right signs and mean error of the distance, normalised units, of the first `count` samples."""
    source = samples.points[:count].astype(np.float64) / samples.frame.scale + samples.frame.center
    truth = signed_distance(clean, source) * samples.frame.scale
    sdf = samples.sdf[:count]
    return float(np.mean((sdf < 0) == (truth < 0))), float(np.mean(np.abs(sdf - truth)))
