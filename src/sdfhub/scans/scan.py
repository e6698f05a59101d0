"""Files of scans: meshes, point clouds with or without normals, signed samples. Read whole, checked once."""

import io
import re
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sdfhub.data.sources.deepsdf import npz_array, read_samples
from sdfhub.data.sources.mesh_files import FORMATS as MESHES
from sdfhub.data.sources.mesh_files import MAX_BYTES, check_length, read_mesh
from sdfhub.errors import RejectedMesh, SdfhubError
from sdfhub.shapes import Frame

FORMATS = (*MESHES, ".xyz", ".npy", ".npz")
LEAST = 50  # points from which a shape may be guessed
_PARTS = {"points", "sdf", "normals", "sensor", "center", "scale"}
_HEADER = re.compile(rb"\Aply\r?\n.*?end_header\r?\n", re.DOTALL)
_FACES = re.compile(rb"^element\s+(?:face|tristrips)\s+[1-9]", re.MULTILINE)


@dataclass(frozen=True)
class Scan:
    """What a file tells of one shape, in the file's frame and units.

    Args:
        points: [N, 3] float64: vertices, surface points, or places of signed samples.
        normals: [N, 3] float64 outward normals of surface points, made unit; None where not known.
        faces: [F, 3] int64 rows of `points`, of a mesh; else None.
        sdf: [N] float64 of signed samples, negative inside, normalised frame; else None.
        sensor: [3] float64, the place from which all points were seen; None where not known.
        frame: of signed samples: where the normalised frame lies in their source's; None where not known.
    """

    points: np.ndarray
    normals: np.ndarray | None = None
    faces: np.ndarray | None = None
    sdf: np.ndarray | None = None
    sensor: np.ndarray | None = None
    frame: Frame | None = None

    def __post_init__(self):
        if self.points.ndim != 2 or self.points.shape[1] != 3 or self.points.dtype.kind != "f":
            raise ValueError(f"points must be [N, 3] numbers, they are {list(self.points.shape)}")
        count = len(self.points)
        if count < LEAST and self.faces is None:
            raise ValueError(f"holds {count} points; at least {LEAST} are needed to know a shape")
        shapes = {"points": (count, 3), "normals": (count, 3), "sdf": (count,), "sensor": (3,)}
        for name, shape in shapes.items():
            part = getattr(self, name)
            if part is not None and part.shape != shape:
                raise ValueError(f"{name} must be {list(shape)} numbers, they are {list(part.shape)}")
            if part is not None and (bad := int((~np.isfinite(part)).sum())):
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
    and `sdf` (and `center`, `scale`) are signed samples; `points`, and `normals` and `sensor` if there, are
    a cloud.

    Raises:
        SdfhubError: one line that names the file and says what is wrong.
    """
    path = Path(path)
    if path.suffix.lower() not in FORMATS:
        raise SdfhubError(f"{path}: not a format of scans known here ({' '.join(FORMATS)})")
    if not path.is_file():
        raise SdfhubError(f"{path}: no such file")
    if path.stat().st_size > MAX_BYTES:
        raise SdfhubError(f"{path}: larger than {MAX_BYTES >> 20} MiB; thin it out first")
    readers = {".ply": _ply, ".xyz": _text, ".npy": _array, ".npz": _archive}
    try:
        return readers.get(path.suffix.lower(), _mesh)(path)
    except RejectedMesh as rejection:
        raise SdfhubError(rejection.detail) from rejection
    except SdfhubError:
        raise
    except Exception as error:  # the readers raise whatever broken bytes lead to
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise SdfhubError(f"{path}: {reason}") from error


def _mesh(path: Path) -> Scan:
    vertices, faces = read_mesh(path)
    return Scan(vertices, faces=faces)


def _ply(path: Path) -> Scan:
    content = path.read_bytes()
    header = _HEADER.match(content)
    if header is None:
        raise ValueError("not a PLY file, or one that ends within its header")
    if _FACES.search(header[0]):
        return _mesh(path)
    import trimesh  # here: slow to import

    try:
        check_length(content, ".ply")
        cloud = trimesh.load(io.BytesIO(content), file_type="ply", process=False)
        columns = cloud.metadata["_ply_raw"]["vertex"]["data"]
        names = columns.dtype.names if hasattr(columns, "dtype") else columns
        wanted = ["x", "y", "z", "nx", "ny", "nz"]
        wanted = wanted if set(wanted) <= set(names) else wanted[:3]
        rows = [np.asarray(columns[name], np.float64).reshape(-1) for name in wanted]
    except Exception as error:  # whatever a cut or damaged file leads trimesh to
        raise ValueError("cannot be read as ply; it may be cut off or damaged") from error
    return _cloud(np.stack(rows, axis=1))


def _cloud(rows: np.ndarray) -> Scan:
    if rows.ndim != 2 or rows.shape[1] not in (3, 6):
        raise ValueError(f"expected rows x y z or x y z nx ny nz, got an array {list(rows.shape)}")
    rows = rows.astype(np.float64)
    return Scan(rows[:, :3], rows[:, 3:] if rows.shape[1] == 6 else None)


def _text(path: Path) -> Scan:
    return _cloud(np.loadtxt(path, ndmin=2))


def _array(path: Path) -> Scan:
    rows = np.load(path, mmap_mode="r", allow_pickle=False)  # a header that claims more than the file fails
    if rows.dtype.kind != "f":
        raise ValueError(f"expected floating-point numbers, got {rows.dtype}")
    return _cloud(np.array(rows))


def _archive(path: Path) -> Scan:
    with zipfile.ZipFile(path) as archive:
        names = {name.removesuffix(".npy") for name in archive.namelist()}
    if {"pos", "neg"} <= names:
        samples = read_samples(path)
        points, sdf = samples.points.astype(np.float64), samples.sdf.astype(np.float64)
        return Scan(points, sdf=sdf, frame=samples.frame)
    if "points" not in names:
        contents = ", ".join(sorted(names)) or "nothing"
        raise ValueError(f"holds {contents}; expected pos and neg, points and sdf, or points")
    parts = {name: npz_array(path, name).astype(np.float64) for name in names & _PARTS}
    if "sdf" not in parts:
        return Scan(parts["points"], parts.get("normals"), sensor=parts.get("sensor"))
    frame = Frame(parts.get("center", np.zeros(3)), float(parts.get("scale", np.ones(1)).ravel()[0]))
    return Scan(parts["points"], sdf=parts["sdf"], frame=frame)
