"""Inside or outside: rival methods with one signature, and the exact distance for all of them.

libigl's own signed distance by fast winding number returns wrong magnitudes: sign and distance stand apart.
"""

from collections.abc import Callable
from typing import NamedTuple

import igl
import numpy as np
from scipy.spatial import cKDTree

from sdfhub.data.preparation.visibility import Surface
from sdfhub.geometry.morton import morton_codes, morton_order
from sdfhub.geometry.surface_sampling import points_on_faces, random_faces
from sdfhub.geometry.triangle_tree import TriangleTree
from sdfhub.triangles import face_normals

VOTES, VOTERS = 11, 250_000  # neighbours that vote, of how many visible points (DeepSDF's code)
INNER = 0.95  # part of the radius of an empty ball whose points take the winding number of its centre
CLEAR = 0.1  # distance of a winding number from a whole one below which other points may take it
ROUGH, CLOSE = 1.0, 2.0  # radii from which libigl sums up faces: errors to 0.6 (1 in 1000 above 0.3), 0.01
LONGEST, LONGEST_FOR_FEW = 0.1, 0.3  # edges: longer ones are cut before a tree is built over faces
FEW = 10_000  # points, for which a tree of less cut faces is built sooner than it is slower
ROOM = 50_000  # pieces that cutting may add: it pays where few triangles are long


class Nearest(NamedTuple):
    """What of a surface is nearest to N points."""

    distance: np.ndarray  # [N], unsigned
    face: np.ndarray  # [N] rows
    foot: np.ndarray  # [N, 3]


class Signs(NamedTuple):
    """The sides on which N points lie."""

    inside: np.ndarray  # [N]
    certain: np.ndarray  # [N] far enough from a tie


# takes points [N, 3], their nearest points of the surface, the surface and a source of chance
SignMethod = Callable[[np.ndarray, Nearest, Surface, np.random.Generator], Signs]


def nearest_points(points: np.ndarray, surface: Surface) -> Nearest:
    """Exact unsigned distances to all faces of points [N, 3] float64; fastest in `morton_order`."""
    return Nearest(*TriangleTree(surface.vertices[surface.faces]).nearest(points))


def winding_signs(points: np.ndarray, nearest: Nearest, surface: Surface, rng: np.random.Generator) -> Signs:
    """Inside where the generalised winding number of the solid faces is above 1/2."""
    winding = winding_numbers(points, nearest.distance, surface)
    return Signs(winding > 0.5, np.abs(winding - 0.5) > 0.25)


def winding_numbers(points: np.ndarray, distance: np.ndarray, surface: Surface) -> np.ndarray:
    """[N] generalised winding numbers of the solid faces around points [N, 3], `distance` [N] from any face.

    Source: Barill et al. 2018, Fast Winding Numbers for Soups and Clouds. No face crosses the ball around a
    point whose radius is its distance: the number is computed for the centres of such balls only, from large
    cells to small ones, and handed to the other points of the ball when it is clearly a whole one.
    """
    order = morton_order(points)
    points, distance = points[order], distance[order]
    codes, winding, todo = morton_codes(points), np.empty(len(points)), np.arange(len(points))
    tree, longest = igl.FastWindingNumberBVH(), LONGEST if len(points) > FEW else LONGEST_FOR_FEW
    tree.init(*cut_long(surface.vertices, surface.solid(), longest), 2)
    for level in range(8, 0, -1):  # cells of 3/4 down to 6/1024 a side
        if not len(todo):
            break
        largest, cell = _largest_of_runs(codes[todo] >> 3 * level, distance[todo])
        centre = todo[largest]
        winding[centre] = _winding_numbers(tree, points[centre])
        is_clear = np.abs(winding[centre] - np.round(winding[centre])) < CLEAR
        reach = np.where(is_clear, INNER * distance[centre], 0)[cell]
        apart = points[todo] - points[centre[cell]]
        shared = np.einsum("nj,nj->n", apart, apart) < reach**2
        winding[todo[shared]] = winding[centre[cell[shared]]]
        shared[largest] = True
        todo = todo[~shared]
    winding[todo] = _winding_numbers(tree, points[todo])
    winding[order] = winding.copy()
    return winding


def _winding_numbers(tree: igl.FastWindingNumberBVH, points: np.ndarray) -> np.ndarray:
    """[N] winding numbers, roughly where they are far from 1/2, closely elsewhere."""
    winding = tree.winding_number(points, ROUGH)
    unclear = np.flatnonzero(np.abs(winding - 0.5) < 0.5 - CLEAR)
    winding[unclear] = tree.winding_number(points[unclear], CLOSE)
    return winding


def _largest_of_runs(keys: np.ndarray, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The row of the largest value in each run of equal keys, [R], and the run of each row, [N]."""
    starts = np.diff(keys, prepend=-1) != 0
    run = np.cumsum(starts) - 1
    rows = np.flatnonzero(value == np.maximum.reduceat(value, np.flatnonzero(starts))[run])
    largest = np.empty(run[-1] + 1, np.int64)
    largest[run[rows]] = rows
    return largest, run


def vote_signs(points: np.ndarray, nearest: Nearest, surface: Surface, rng: np.random.Generator) -> Signs:
    """Inside where most of the nearest visible points face away; certain if all of them agree.

    Source: DeepSDF (Park et al. 2019), section 5, with 11 votes as in its code.
    """
    normals = face_normals(surface.vertices, surface.faces)
    area = np.linalg.norm(normals, axis=1)
    face = random_faces(area, VOTERS, rng)
    voters = points_on_faces(surface.vertices[surface.faces], face, rng)
    is_turned = surface.two_sided[face] & (rng.random(VOTERS) < 0.5)  # sheets are seen from either side
    normal = np.where(is_turned[:, None], -normals[face], normals[face])
    order = morton_order(voters)
    voters, normal = voters[order], normal[order]
    _, near = cKDTree(voters, balanced_tree=False).query(points, VOTES)
    behind = np.einsum("nkj,nkj->nk", points[:, None] - voters[near], normal[near]) < 0
    votes = behind.sum(axis=1)
    return Signs(votes > VOTES / 2, (votes == 0) | (votes == VOTES))


def pseudo_normal_signs(
    points: np.ndarray, nearest: Nearest, surface: Surface, rng: np.random.Generator
) -> Signs:
    """Inside where the angle-weighted normal at the nearest point looks away; for clean closed meshes only.

    Source: Baerentzen and Aanaes 2005, Signed Distance Computation Using the Angle Weighted Pseudonormal.
    """
    vertices, faces = surface.vertices, surface.faces
    doubled = face_normals(vertices, faces)
    normals = doubled / np.linalg.norm(doubled, axis=1, keepdims=True)
    edges = np.roll(vertices[faces], -1, axis=1) - vertices[faces]  # [F, 3, 3], edge i from corner i
    edges /= np.linalg.norm(edges, axis=2, keepdims=True)
    angles = np.arccos(-np.einsum("fij,fij->fi", edges, np.roll(edges, 1, axis=1)).clip(-1, 1))
    low, high = np.sort([faces, np.roll(faces, -1, axis=1)], axis=0)
    _, edge = np.unique(low * len(vertices) + high, return_inverse=True)
    of_edges = _sums(edge, np.repeat(normals[:, None], 3, axis=1))
    of_corners = _sums(faces, angles[..., None] * normals[:, None])
    directions = np.concatenate([normals[:, None], of_edges, of_corners], axis=1)  # [F, 7, 3]
    shares = _barycentric(nearest, vertices[faces], doubled)
    on_edge = shares < 1e-6
    part = np.where(on_edge.any(axis=1), 1 + (shares.argmin(axis=1) + 1) % 3, 0)  # the edge opposite
    part = np.where(on_edge.sum(axis=1) > 1, 4 + shares.argmax(axis=1), part)
    away = np.einsum("nj,nj->n", points - nearest.foot, directions[nearest.face, part])
    return Signs(away < 0, np.ones(len(points), bool))


def _sums(rows: np.ndarray, parts: np.ndarray) -> np.ndarray:
    """[F, 3, 3]: for every row [F, 3], the sum of all parts [F, 3, 3] of equal rows."""
    rows = rows.reshape(-1)
    sums = [np.bincount(rows, parts[..., axis].ravel()) for axis in range(3)]
    return np.stack(sums, axis=1)[rows].reshape(parts.shape)


def _barycentric(nearest: Nearest, corners: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """[N, 3] coordinates of the feet in their triangles [F, 3, 3], which have `face_normals` [F, 3]."""
    normals = normals / np.sum(normals**2, axis=1, keepdims=True)
    opposite = [np.cross(normals, corners[:, (i + 2) % 3] - corners[:, (i + 1) % 3]) for i in range(3)]
    slopes, at = np.stack(opposite, axis=1), corners[:, [1, 2, 0]]
    offsets = np.einsum("fij,fij->fi", slopes, at)
    return np.einsum("nij,nj->ni", slopes[nearest.face], nearest.foot) - offsets[nearest.face]


def cut_long(vertices: np.ndarray, faces: np.ndarray, longest: float) -> tuple[np.ndarray, np.ndarray]:
    """Triangles halved across their longest edge until none is longer than `longest`, or ROOM is used up.

    The long thin triangles of a chair's legs make fast winding numbers visit nearly all.
    Returns vertices [V + M, 3] and faces [F + M, 3].
    """
    left, room = np.arange(len(faces)), ROOM
    while len(left):
        corners = vertices[faces[left]]
        squared = np.sum((np.roll(corners, -1, axis=1) - corners) ** 2, axis=2)
        long = squared.max(axis=1) > longest**2
        left, edge = left[long], squared[long].argmax(axis=1)
        if not 0 < len(left) <= room:
            break
        room -= len(left)
        a, b, c = (faces[left, (edge + i) % 3] for i in range(3))
        middle = len(vertices) + np.arange(len(left))
        vertices = np.concatenate([vertices, (vertices[a] + vertices[b]) / 2])
        first, second = np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)
        faces = np.concatenate([faces, second])
        faces[left] = first
        left = np.concatenate([left, np.arange(len(faces) - len(left), len(faces))])
    return vertices, faces


SIGN_METHODS: dict[str, SignMethod]
SIGN_METHODS = {"winding": winding_signs, "vote": vote_signs, "pseudo_normal": pseudo_normal_signs}
