"""A scan that was dropped on a page: its bytes become the code of a shape."""

from pathlib import Path, PurePath
from tempfile import TemporaryDirectory

import numpy as np
import trimesh
from torch import Tensor

from sdfhub.errors import SdfhubError
from sdfhub.scans import scan as scans
from sdfhub.scans.observed_scan import observe
from sdfhub.scans.scan import Scan, read_scan
from sdfhub.space import Space

FORMATS = tuple(suffix for suffix in scans.FORMATS if suffix != ".npz")
"""Meshes and clouds of a whole shape. Archives also carry views and samples, whose frame has to be said."""

POINTS = 4000
"""Points of a scan's surface that are shown."""


def fit_scan(space: Space, name: str, content: bytes) -> tuple[Tensor, np.ndarray]:
    """The code [L] of the shape in a file, and points [M, 3] of the scan's surface, normalised frame.

    Args:
        space: where the shape is looked for.
        name: of the file, for messages and its suffix; nothing is opened under it.
        content: of the file.

    Raises:
        SdfhubError: names the file and what is wrong with it.
    """
    suffix = PurePath(name).suffix.lower()
    if suffix not in FORMATS:
        raise SdfhubError(f"{name}: not a format known here ({' '.join(FORMATS)})")
    rng = np.random.default_rng(0)
    with TemporaryDirectory() as folder:  # a .gltf can name files of its folder: there are none
        path = Path(folder) / f"scan{suffix}"
        path.write_bytes(content)
        try:
            scan = read_scan(path)
            observed = observe(scan, space.evidence, "shape", rng)
            code = space.fit_observations([observed.observation]).codes[0]
        except (SdfhubError, ValueError) as error:
            reason = str(error).replace(str(path), name)
            raise SdfhubError(reason if name in reason else f"{name}: {reason}") from error
    return code, observed.frame.to_normalized(surface_points(scan, rng)).astype(np.float32)


def surface_points(scan: Scan, rng: np.random.Generator) -> np.ndarray:
    """At most POINTS points [M, 3] of a scan's surface, in its frame: all over a mesh, or of a cloud."""
    if scan.faces is None:
        return scan.points[rng.permutation(len(scan.points))[:POINTS]]
    mesh = trimesh.Trimesh(scan.points, scan.faces, process=False)
    return np.asarray(trimesh.sample.sample_surface(mesh, POINTS, seed=rng)[0])
