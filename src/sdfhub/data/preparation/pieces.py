"""Long triangles cut into pieces: the same surface, in boxes that fit it more tightly.

Trees over triangles prune by boxes, and fast winding numbers sum up compact groups: the long thin triangles
of a chair's legs make both visit nearly all triangles.
"""

import numpy as np

ROOM = 50_000
"""Pieces that cutting may add: it pays where few triangles are long, and memory stays bounded."""


def cut_long(vertices: np.ndarray, faces: np.ndarray, longest: float) -> tuple[np.ndarray, ...]:
    """Triangles halved across their longest edge until none is longer than `longest`, or ROOM is used up.

    Returns:
        vertices [V + M, 3], faces [F + M, 3] that turn as the given ones do, and of each of these the row
        [F + M] of the face it is a piece of.
    """
    source, left = np.arange(len(faces)), np.arange(len(faces))
    room = ROOM
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
        faces, source = np.concatenate([faces, second]), np.concatenate([source, source[left]])
        faces[left] = first
        left = np.concatenate([left, np.arange(len(faces) - len(left), len(faces))])
    return vertices, faces, source
