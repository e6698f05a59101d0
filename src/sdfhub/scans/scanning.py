"""Simulated scans of a mesh: points all over it, or what one sensor sees."""

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from sdfhub.geometry.surface_sampling import sample_surface
from sdfhub.shapes import NormalizedMesh

HALF_VIEW = np.tan(np.radians(24))
"""Half the width of a sensor's picture at distance 1: wide enough for the unit ball from 2.5 away."""


def surface_scan(
    mesh: NormalizedMesh, count: int, noise: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Points [count, 3] spread evenly over a mesh, moved by normal noise, and their faces' normals.

    Args:
        mesh: its faces turned outwards.
        count: points.
        noise: standard deviation along each axis, normalised frame.
        rng: of the points.
    """
    points, normals = sample_surface(mesh.vertices, mesh.faces, count, rng)
    return points + noise * rng.standard_normal(points.shape), normals


def view_scan(
    mesh: NormalizedMesh, sensor: np.ndarray, pixels: int, noise: float, rng: np.random.Generator
) -> np.ndarray:
    """What a sensor that looks at the origin sees of a mesh: [M, 3] points, at most one a pixel.

    Args:
        mesh: what stands there.
        sensor: [3], outside the unit ball, normalised frame.
        pixels: of the picture, either way.
        noise: standard deviation along the rays.
        rng: of the noise.
    """
    scene = EmbreeScene()
    TriangleMesh(scene, mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32))
    forward = -sensor / np.linalg.norm(sensor)
    right = np.cross(forward, np.eye(3)[np.abs(forward).argmin()])
    right /= np.linalg.norm(right)
    steps = ((np.arange(pixels) + 0.5) / pixels * 2 - 1) * HALF_VIEW
    x, y = np.meshgrid(steps, steps)
    rays = forward + x.reshape(-1, 1) * right + y.reshape(-1, 1) * np.cross(right, forward)
    rays = (rays / np.linalg.norm(rays, axis=1, keepdims=True)).astype(np.float32)
    origins = np.broadcast_to(sensor.astype(np.float32), rays.shape).copy()
    hits = scene.run(origins, rays, query="INTERSECT", output=1)
    seen = hits["primID"] >= 0
    depth = hits["tfar"][seen] + noise * rng.standard_normal(seen.sum())
    return sensor + depth[:, None] * rays[seen].astype(np.float64)
