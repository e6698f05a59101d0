"""Data that parts of sdfhub hand to each other: meshes, samples, observations, batches; checked here, once.

Frame: a shape's bounding-box centre lies at 0 and its farthest vertex at 1 / 1.03, so all of it lies
in the unit ball; `source = normalised / scale + center`. Sign: negative inside.
"""

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

if TYPE_CHECKING:
    import torch

RADIUS = 1 / 1.03  # of the farthest vertex from the centre, normalised frame (DeepSDF's buffer of 3%)
_PART = r"[A-Za-z0-9][A-Za-z0-9_.+-]{0,119}"
SHAPE_ID = rf"^{_PART}(/{_PART})*$"  # such as `chairs/0007`: a path below a folder that never leads out
UpAxis = Literal["y", "z"]  # of a world


def check_id(id: str) -> None:
    """Raises ValueError for an id that is not safe as a path below a folder."""
    if not isinstance(id, str) or not re.fullmatch(SHAPE_ID, id):
        raise ValueError(f"shape id {id!r}: parts must be letters, digits or _ . + -")


def _check(owner: Any, **layouts: tuple) -> None:
    """Raises ValueError where a field has other sizes (a letter stands for one), or another dtype (last)."""
    sizes: dict[Any, int] = {}
    for name, (*layout, dtype) in layouts.items():
        array = getattr(owner, name)
        pairs = zip(layout, array.shape, strict=False)
        fits = all((want if want == 3 else sizes.setdefault(want, have)) == have for want, have in pairs)
        if not fits or len(array.shape) != len(layout) or array.dtype != dtype:
            raise ValueError(f"{name}: expected {layout} {dtype}, got {list(array.shape)} {array.dtype}")


def turned_up(points: np.ndarray, up: UpAxis, wanted: UpAxis) -> np.ndarray:
    """Points [N, 3] of a world with `up` up in one with `wanted` up; the front looks to +z or -y then."""
    if up == wanted:
        return points
    x, y, z = np.asarray(points).T
    return np.column_stack([x, -z, y] if wanted == "z" else [x, z, -y])


class Mesh(NamedTuple):
    """A triangle mesh in any frame."""

    vertices: np.ndarray  # [V, 3] float64
    faces: np.ndarray  # [F, 3] int64 rows of vertices, counter-clockwise seen from outside; F = 0: empty


@dataclass(frozen=True, eq=False)
class Frame:
    """Where a shape's normalised frame lies in its source's frame."""

    center: np.ndarray  # [3] float64, source units
    scale: float  # normalised units per source unit, > 0

    def __post_init__(self) -> None:
        _check(self, center=(3, np.float64))
        if not (np.isfinite(self.center).all() and np.isfinite(self.scale) and self.scale > 0):
            raise ValueError(f"frame: no finite center {self.center} and positive scale {self.scale}")

    @classmethod
    def around(cls, points: np.ndarray) -> tuple["Frame", np.ndarray]:
        """The frame that centres the bounding box of points [N, 3], and the points in it [N, 3].

        Raises ValueError where the points lie in one place, or too far apart to be measured.
        """
        low, high = points.min(axis=0), points.max(axis=0)
        half, center = high / 2 - low / 2, high / 2 + low / 2  # halves first: a sum may overflow
        size = max(half.max(), np.finfo(np.float64).tiny)
        unit = (points - center) / size  # near 1 before squares are taken
        factor = RADIUS / max(np.linalg.norm(unit, axis=1).max(), np.finfo(np.float64).tiny)
        return cls(center, float(factor / size)), unit * factor

    def to_source(self, points: np.ndarray) -> np.ndarray:
        """Points [N, 3] of the normalised frame in the source's."""
        return points / self.scale + self.center

    def to_normalized(self, points: np.ndarray) -> np.ndarray:
        """Points [N, 3] of the source's frame in the normalised one."""
        return (points - self.center) * self.scale


NORMALIZED = Frame(np.zeros(3), 1.0)  # of a shape that has no source


@dataclass(frozen=True)
class NormalizedMesh:
    """A triangle mesh in the normalised frame."""

    vertices: np.ndarray  # [V, 3] float64, all within the unit ball
    faces: np.ndarray  # [F, 3] int64 rows of vertices, counter-clockwise seen from outside
    frame: Frame = NORMALIZED

    def __post_init__(self) -> None:
        _check(self, vertices=("V", 3, np.float64), faces=("F", 3, np.int64))
        if not np.linalg.norm(self.vertices, axis=1).max(initial=0) <= 1 + 1e-6:  # also where one is NaN
            raise ValueError("vertices: must be finite and inside the unit ball")
        if self.faces.size and not 0 <= self.faces.min() <= self.faces.max() < len(self.vertices):
            raise ValueError("faces: index a vertex that is not there")


@dataclass(frozen=True)
class ShapeSamples:
    """Signed distances and oriented surface points of one shape, normalised frame."""

    points: np.ndarray  # [N, 3] float32; jitter leaves the cube [-1, 1]^3 a little
    sdf: np.ndarray  # [N] float32, negative inside
    surface_points: np.ndarray  # [M, 3] float32; M = 0 where the source has none
    surface_normals: np.ndarray  # [M, 3] float32, unit length, outward
    frame: Frame
    mesh: NormalizedMesh | None  # the oriented faces that were sampled; DeepSDF's npz have none
    statistics: dict[str, float]  # of the preparation (two-sided area, inside fraction, ...)

    def __post_init__(self) -> None:
        surface = ("M", 3, np.float32)
        _check(self, points=("N", 3, np.float32), sdf=("N", np.float32))
        _check(self, surface_points=surface, surface_normals=surface)
        arrays = self.points, self.sdf, self.surface_points, self.surface_normals
        if not all(np.isfinite(array).all() for array in arrays):
            raise ValueError("samples: all must be finite")
        if np.abs(np.linalg.norm(self.surface_normals, axis=1) - 1).max(initial=0) > 1e-3:
            raise ValueError("surface_normals: must have unit length")


@dataclass(frozen=True)
class Observation:
    """Bounds on the signed distances of one shape at some points, in random order.

    A sample of the field has equal bounds; a point on the surface has 0 and 0; a point that a ray crossed
    has 0 or more below; any point has its distance to the observed surface above.
    """

    points: np.ndarray  # [N, 3] float32, N > 0, normalised frame (or that of an unknown similarity)
    low: np.ndarray  # [N] float32, least signed distance
    high: np.ndarray  # [N] float32, largest
    unsigned: np.ndarray  # [N] bool, whether low and high bound the absolute value, since no side is known
    noise: float = 0.0  # standard deviation of the surface points, same frame, >= 0
    partial: bool = False  # whether a part of the shape's surface was not seen

    def __post_init__(self) -> None:
        bound = ("N", np.float32)
        _check(self, points=("N", 3, np.float32), low=bound, high=bound, unsigned=("N", np.bool_))
        arrays = self.points, self.low, self.high
        if not len(self.points) or not all(np.isfinite(array).all() for array in arrays):
            raise ValueError("points, low and high: must be finite, at least one")
        if (self.low > self.high).any() or not 0 <= self.noise < np.inf:
            raise ValueError("low must not lie above high, noise must be a number >= 0")

    @classmethod
    def of_samples(cls, points: np.ndarray, sdf: np.ndarray) -> "Observation":
        """Signed samples: points [N, 3] and their distances [N], in random order."""
        sdf, points = np.ascontiguousarray(sdf, np.float32), np.ascontiguousarray(points, np.float32)
        return cls(points, sdf, sdf, np.zeros(len(sdf), np.bool_))

    @property
    def is_exact(self) -> bool:
        """Whether all distances are known, inside too: signed samples."""
        return not self.unsigned.any() and np.array_equal(self.low, self.high) and bool(self.low.min() < 0)


@dataclass(frozen=True)
class Batch:
    """Samples of B shapes for one training step, normalised frame; the shape axis is kept."""

    rows: "torch.Tensor"  # [B] int64, row of each shape in the code table
    points: "torch.Tensor"  # [B, N, 3] float32
    sdf: "torch.Tensor"  # [B, N] float32, negative inside
    surface_points: "torch.Tensor"  # [B, M, 3] float32; M = 0 without normals
    surface_normals: "torch.Tensor"  # [B, M, 3] float32, unit length, outward

    def __post_init__(self) -> None:
        import torch  # here: meshes and samples do without it

        points, surface = ("B", "N", 3, torch.float32), ("B", "M", 3, torch.float32)
        _check(self, rows=("B", torch.int64), points=points, sdf=("B", "N", torch.float32))
        _check(self, points=points, surface_points=surface, surface_normals=surface)

    def to(self, device: "torch.device | str", non_blocking: bool = False) -> "Batch":
        """The same batch on another device."""
        return Batch(*(getattr(self, f).to(device, non_blocking=non_blocking) for f in self.__match_args__))
