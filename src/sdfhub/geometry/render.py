"""Meshes within the unit ball, +z up, front towards -y, to pictures by ray casting, without a display."""

import igl
import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from sdfhub.geometry.surface import face_normals, sphere_directions
from sdfhub.shapes import UpAxis, turned_up

_CLAY = np.array([0.30, 0.46, 0.72])  # surface colour, linear RGB
_KEY = np.array([-0.45, -0.6, 0.95]) / np.linalg.norm([-0.45, -0.6, 0.95])  # towards the light
_CREASE = 38.0  # degrees; edges sharper than this stay sharp
_SMOOTH_FACES = 200_000  # above it a face is about a pixel and smoothing shows nothing
_FAR = 5.0  # of the camera from the origin


def render(
    vertices, faces, size: int = 256, *, up: UpAxis = "z", azimuth=-55.0, elevation=24.0, background=1.0
) -> np.ndarray:
    """A shaded picture [size, size, 3] uint8 of a mesh [V, 3], [F, 3] within the unit ball, both sides lit.

    The camera stands `azimuth` degrees around z, from +x towards +y, where -90 looks at the front, and
    `elevation` degrees above the horizon. Without faces it sees the background, an sRGB grey in [0, 1].
    """
    image = np.full((2 * size * 2 * size, 3), background**2.2)
    faces = np.asarray(faces)
    if len(faces):
        vertices = turned_up(np.asarray(vertices, dtype=np.float64), up, "z")
        a, e = np.radians([azimuth, elevation])
        eye = _FAR * np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        right, half = np.array([-np.sin(a), np.cos(a), 0.0]), 1 / np.sqrt(_FAR**2 - 1)  # frames the unit ball
        scene, rays, hits = seen_from(eye, right, half, 2 * size, vertices, faces)
        seen = np.flatnonzero(hits["primID"] >= 0)
        points = eye + hits["tfar"][seen, None] * rays[seen]
        normals, flat = _normals(vertices, faces, hits, seen, rays[seen])
        row, column = np.divmod(seen, 2 * size)
        subpixel = 2 * (row % 2) + column % 2  # which of its pixel's four samples a ray is
        image[seen] = _CLAY * _light(scene, (points + 2e-3 * flat).astype(np.float32), normals, subpixel)
    image = image.reshape(size, 2, size, 2, 3).mean(axis=(1, 3))[::-1]
    return (np.clip(image, 0, 1) ** (1 / 2.2) * 255 + 0.5).astype(np.uint8)


def slice_image(sdf_grid: np.ndarray, delta: float) -> np.ndarray:
    """A slice [R, R], x to the right, as a picture [R, R, 3] uint8: blue inside, orange outside, zero black.

    Colours saturate at delta; there is a line every delta / 4.
    """
    sdf = np.asarray(sdf_grid, dtype=np.float64).T[::-1]
    amount = np.clip(np.abs(sdf) / delta, 0, 1)[..., None]
    inside, outside, paper = np.array([38, 84, 168]), np.array([214, 108, 24]), np.array([252, 250, 246])
    image = paper + (np.where(sdf[..., None] < 0, inside, outside) - paper) * (0.15 + 0.85 * amount)
    image[_changes(np.floor(np.clip(sdf, -delta, delta) / (delta / 4)))] *= 0.78
    image[_changes(sdf < 0)] = 0
    return np.nan_to_num(image).astype(np.uint8)


def _changes(labels: np.ndarray) -> np.ndarray:
    """Pixels whose right or lower neighbour has another label."""
    down, right = np.diff(labels, axis=0, append=labels[-1:]), np.diff(labels, append=labels[:, -1:])
    return (down != 0) | (right != 0)


def seen_from(
    eye: np.ndarray, right: np.ndarray, half: float, pixels: int, vertices: np.ndarray, faces: np.ndarray
) -> tuple[EmbreeScene, np.ndarray, dict[str, np.ndarray]]:
    """What a camera sees of a mesh: the scene, unit rays [pixels^2, 3] from the lowest row up, their hits.

    It stands at `eye` [3] and looks at the origin; `half` is half the width of its picture at distance 1.
    """
    scene = EmbreeScene()
    TriangleMesh(scene, vertices.astype(np.float32), faces.astype(np.int32))
    forward = -eye / np.linalg.norm(eye)
    steps = ((np.arange(pixels) + 0.5) / pixels * 2 - 1) * half
    x, y = np.meshgrid(steps, steps)
    rays = forward + x.reshape(-1, 1) * right + y.reshape(-1, 1) * np.cross(right, forward)
    rays = (rays / np.linalg.norm(rays, axis=1, keepdims=True)).astype(np.float32)
    origins = np.broadcast_to(eye.astype(np.float32), rays.shape).copy()
    return scene, rays, scene.run(origins, rays, query="INTERSECT", output=1)


def _normals(vertices, faces, hits, seen, directions) -> tuple[np.ndarray, np.ndarray]:
    """Smoothed and flat unit normals at the hits, both turned towards the camera."""
    face = hits["primID"][seen]
    flat = smooth = _unit(face_normals(vertices, faces[face]))
    if len(faces) <= _SMOOTH_FACES:
        corners = igl.per_corner_normals(vertices, faces.astype(np.int64), _CREASE).reshape(-1, 3, 3)[face]
        u, v = hits["u"][seen, None], hits["v"][seen, None]
        smooth = _unit((1 - u - v) * corners[:, 0] + u * corners[:, 1] + v * corners[:, 2])
    sign = np.where(np.einsum("ij,ij->i", flat, directions) > 0, -1.0, 1.0)[:, None]
    return smooth * sign, flat * sign


def _light(scene: EmbreeScene, points: np.ndarray, normals: np.ndarray, subpixel: np.ndarray) -> np.ndarray:
    """[N, 3] light of a key and a sky dome at points [N, 3], about 1 on a level plane, with shadows."""
    # a pixel's four samples are lit by four interleaved sets of lights: their mean is smooth
    key, dome = _unit(_KEY + 0.09 * sphere_directions(12)), sphere_directions(32)
    strength = np.where(dome[:, 2] > -0.15, 0.75 + 0.4 * dome[:, 2], 0.3)  # a pale floor reflects some light
    warm, cool = np.tile([1.0, 0.95, 0.87], (12, 1)) / 3, 0.2 * strength[:, None] * [0.88, 0.95, 1.0]
    directions, colours = np.concatenate([key, dome]), np.concatenate([warm, cool])
    total = np.zeros(points.shape)
    for first in range(0, len(directions), 4):
        lights = directions[first + subpixel]
        cosine = np.clip(np.einsum("ij,ij->i", normals, lights), 0, None)
        facing = np.flatnonzero(cosine > 0)
        hit = scene.run(points[facing], lights[facing].astype(np.float32), query="OCCLUDED") >= 0
        cosine[facing[hit]] = 0
        total += colours[first + subpixel] * cosine[:, None]
    return total


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-30)
