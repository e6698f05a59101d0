"""One mesh of a report as it is shown: a picture, and few enough triangles to turn in a browser."""

import base64
from dataclasses import dataclass, field
from pathlib import Path

import fast_simplification
import numpy as np

from sdfhub.data.store.stored_shape import StoredShape
from sdfhub.geometry.render import render
from sdfhub.report.meshes import Mesh, reconstruction, true_mesh
from sdfhub.report.results import ShapeScore

PIXELS, PAPER = 208, 0.955
"""Side of a picture, and the grey level behind the shape: a tile on a light page and on a dark one."""


@dataclass(frozen=True)
class Subject:
    """What is drawn: a cell's reconstruction of a shape, or the truth where no cell is named.

    Args:
        truth: the prepared shape; None where it is not on this machine.
        folder: of the cell.
        role, score: of the shape in it.
    """

    truth: StoredShape | None
    folder: Path | None = None
    role: str = ""
    score: ShapeScore | None = None

    def mesh(self) -> Mesh | None:
        """Read from its file; None where there is no surface or no file."""
        if self.folder is None:
            return true_mesh(self.truth)
        return reconstruction(self.folder, self.role, self.score, self.truth)


@dataclass(eq=False)
class Drawing:
    """A mesh, what is asked for of it, and, once that is done, what came of it.

    Args:
        subject: what is drawn.

    Attributes:
        image: [S, S, 3] uint8, from the usual side; None without a mesh, or not asked for.
        packs: `packed` meshes by the number of triangles asked for.
        done: whether image and packs are there.
    """

    subject: Subject
    wants_image: bool = False
    wants_packs: set[int] = field(default_factory=set)
    image: np.ndarray | None = None
    packs: dict[int, dict] = field(default_factory=dict)
    done: bool = False

    def pictured(self) -> "Drawing":
        """Asks for a picture."""
        self.done, self.wants_image = self.done and self.wants_image, True
        return self

    def packed(self, triangles: int) -> "Drawing":
        """Asks for the mesh with so many triangles at most."""
        self.done = self.done and triangles in self.wants_packs
        self.wants_packs.add(triangles)
        return self

    @property
    def asked(self) -> tuple[Subject, bool, list[int]]:
        """What `drawn` takes."""
        return self.subject, self.wants_image, sorted(self.wants_packs)


def drawn(asked: tuple[Subject, bool, list[int]]) -> tuple[np.ndarray | None, dict[int, dict]]:
    """The image and the packs of a drawing, in whatever process; nothing where there is no mesh."""
    subject, wants_image, wants_packs = asked
    mesh = subject.mesh()
    if mesh is None:
        return None, {}
    image = render(mesh.vertices, mesh.faces, PIXELS, up=mesh.up, background=PAPER) if wants_image else None
    return image, {triangles: packed(mesh, triangles) for triangles in wants_packs}


def packed(mesh: Mesh, triangles: int) -> dict[str, int | str]:
    """A mesh of at most about `triangles`, +z up, as little-endian 16-bit integers in base64.

    Returns:
        `vertices` and `faces`: counts; `data`: positions times 32767 (int16), then indices (uint16).
    """
    vertices, faces = mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32)
    if len(faces) > triangles:
        vertices, faces = fast_simplification.simplify(vertices, faces, 1 - triangles / len(faces))
    if len(vertices) > 65_535:  # many loose triangles do not decimate
        faces = faces[(faces < 65_535).all(axis=1)]
        vertices = vertices[:65_535]
    if mesh.up == "y":
        vertices = np.column_stack([vertices[:, 0], -vertices[:, 2], vertices[:, 1]])
    places = (np.clip(vertices, -1, 1) * 32767).astype("<i2").tobytes()
    data = base64.b64encode(places + np.asarray(faces).astype("<u2").tobytes()).decode()
    return {"vertices": len(vertices), "faces": len(faces), "data": data}
