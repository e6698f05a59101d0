"""Files of scans: meshes, point clouds with or without normals, signed samples. Read whole, checked once."""

import io
import re
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from sdfhub.data.sources import mesh_files
from sdfhub.data.sources.deepsdf import npz_array, read_samples
from sdfhub.errors import SdfhubError
from sdfhub.shapes import Frame

FORMATS = (*mesh_files.FORMATS, ".xyz", ".npy", ".npz")
LEAST = 50  # points from which a shape may be guessed
_PARTS = {"points", "sdf", "normals", "sensor", "center", "scale"}


@dataclass(frozen=True)
class Scan:
    """What a file tells of one shape, in the file's frame and units. Parts that are not known are None."""

    points: np.ndarray  # [N, 3] float64: vertices, surface points, or places of signed samples
    normals: np.ndarray | None = None  # [N, 3] float64 outward normals of surface points; they are made unit
    faces: np.ndarray | None = None  # [F, 3] int64 rows of `points`, of a mesh
    sdf: np.ndarray | None = None  # [N] float64 of signed samples, negative inside, normalised frame
    sensor: np.ndarray | None = None  # [3] float64, the place from which all points were seen
    frame: Frame | None = None  # of signed samples: where the normalised frame lies in their source's

    def __post_init__(self):
        count = len(self.points)
        if count < LEAST and self.faces is None:
            raise ValueError(f"holds {count} points; at least {LEAST} are needed to know a shape")
        shapes = {"points": (count, 3), "normals": (count, 3), "sdf": (count,), "sensor": (3,)}
        for name, shape in shapes.items():
            if (part := getattr(self, name)) is None:
                continue
            if part.shape != shape or part.dtype.kind != "f":
                raise ValueError(f"{name} must be {list(shape)} numbers, they are {list(part.shape)}")
            if bad := int((~np.isfinite(part)).sum()):
                raise ValueError(f"{bad} numbers of its {name} are not finite; remove those points")
        if self.normals is not None:
            lengths = np.linalg.norm(self.normals, axis=1, keepdims=True)
            if not (lengths > 0).all():
                raise ValueError("some of its normals are zero; remove them, or all normals")
            object.__setattr__(self, "normals", self.normals / lengths)
        if self.sdf is not None and not (self.sdf.min() < 0 <= self.sdf.max()):
            raise ValueError("its signed distances are all on one side; both sides are needed")

    @property
    def kind(self) -> str:
        """What it is: mesh, samples, view, oriented or bare."""
        kinds = {"mesh": self.faces, "samples": self.sdf, "view": self.sensor, "oriented": self.normals}
        return next((kind for kind, part in kinds.items() if part is not None), "bare")


def read_scan(path: str | Path) -> Scan:
    """The scan in a file.

    Meshes as in `read_mesh`; a .ply without faces is a cloud, with normals if its vertices have nx, ny, nz.
    .xyz (text) and .npy: rows x y z or x y z nx ny nz. .npz: `pos` and `neg` are DeepSDF's samples; `points`
    and `sdf` (and `center`, `scale`) are signed samples; `points` (`normals`, `sensor`) are a cloud.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise SdfhubError(f"{path}: not a format of scans known here ({' '.join(FORMATS)})")
    if not path.is_file():
        raise SdfhubError(f"{path}: no such file")
    if path.stat().st_size > mesh_files.MAX_BYTES:
        raise SdfhubError(f"{path}: larger than {mesh_files.MAX_BYTES >> 20} MiB; thin it out first")
    # mapped, a header that claims more than the file fails
    load_array = partial(np.load, mmap_mode="r", allow_pickle=False)
    readers: dict[str, Callable] = {".xyz": np.loadtxt, ".npy": load_array, ".ply": _ply_rows}
    try:
        if suffix == ".npz":
            return _archive(path)
        header = path.read_bytes().partition(b"end_header")[0] if suffix == ".ply" else b""
        has_faces = re.search(rb"^element\s+(?:face|tristrips)\s+[1-9]", header, re.MULTILINE)
        if suffix in readers and not has_faces:
            rows = readers[suffix](path)
            if rows.ndim != 2 or rows.shape[1] not in (3, 6):
                raise ValueError(f"expected rows x y z or x y z nx ny nz, got an array {list(rows.shape)}")
            rows = rows.astype(np.float64)
            return Scan(rows[:, :3], rows[:, 3:] if rows.shape[1] == 6 else None)
        mesh = mesh_files.read_mesh(path)
        return Scan(mesh.vertices, faces=mesh.faces)
    except SdfhubError:
        raise
    except Exception as error:  # the readers raise whatever broken bytes lead to
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise SdfhubError(f"{path}: {reason}") from error


def _ply_rows(path: Path) -> np.ndarray:
    import trimesh  # here: slow to import

    try:
        content = path.read_bytes()
        mesh_files.check_length(content, ".ply")
        cloud = trimesh.load(io.BytesIO(content), file_type="ply", process=False)
        columns = cloud.metadata["_ply_raw"]["vertex"]["data"]
        names = columns.dtype.names if hasattr(columns, "dtype") else columns
        wanted = ["x", "y", "z", "nx", "ny", "nz"]
        wanted = wanted if set(wanted) <= set(names) else wanted[:3]
        return np.stack([np.asarray(columns[name], np.float64).reshape(-1) for name in wanted], axis=1)
    except Exception as error:  # whatever a cut or damaged file leads trimesh to
        raise ValueError("cannot be read as ply; it may be cut off or damaged") from error


def _archive(path: Path) -> Scan:
    with zipfile.ZipFile(path) as archive:
        names = {name.removesuffix(".npy") for name in archive.namelist()}
    if {"pos", "neg"} <= names:
        samples = read_samples(path)
        points, sdf = samples.points.astype(np.float64), samples.sdf.astype(np.float64)
        return Scan(points, sdf=sdf, frame=samples.frame)
    if "points" not in names:
        raise ValueError(f"holds {', '.join(sorted(names)) or 'nothing'}; expected points, or pos and neg")
    parts = {name: npz_array(path, name).astype(np.float64) for name in names & _PARTS}
    if "sdf" not in parts:
        return Scan(parts["points"], parts.get("normals"), sensor=parts.get("sensor"))
    frame = Frame(parts.get("center", np.zeros(3)), float(parts.get("scale", np.ones(1)).ravel()[0]))
    return Scan(parts["points"], sdf=parts["sdf"], frame=frame)
