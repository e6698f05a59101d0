"""Simulated scans of a shape: kinds of scans, and points all over a mesh or what one sensor sees of it."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from sdfhub.data.store.store import shape_seed
from sdfhub.data.store.stored_shape import StoredShape, signed_samples
from sdfhub.errors import SdfhubError
from sdfhub.geometry.render import seen_from
from sdfhub.geometry.surface_sampling import sample_surface
from sdfhub.scans.evidence import Evidence
from sdfhub.scans.observed_scan import ObservedScan, observe
from sdfhub.scans.scan import LEAST, Scan
from sdfhub.shapes import NORMALIZED, NormalizedMesh, UpAxis

NOISES = (0.0, 0.0035, 0.005, 0.007, 0.01, 0.014, 0.02, 0.028, 0.04, 0.056)  # told apart, normalised frame
HALF_VIEW = np.tan(np.radians(24))  # half a picture's width at distance 1: holds the unit ball from 2.5 away
DISTANCE, HEIGHT = 2.5, 0.5  # of sensors from the origin, and how far up they may stand, as a sine
PIXELS = 100
LOOKS = 20  # places tried for a sensor, until it sees enough points to know a shape
VIEWS = 2  # simulated of each shape: a view depends on where the sensor stood


@dataclass(frozen=True)
class ScanKind:
    """What scans have in common that are judged by the same limits: what can be simulated."""

    kind: str  # samples, oriented, bare or view
    count: int = 0  # points, a power of two; 0 where their number does not matter
    noise: float = 0.0  # one of NOISES

    @classmethod
    def of(cls, scan: ObservedScan) -> "ScanKind":
        if scan.kind == "samples":
            return cls("samples")
        least = 0.95 * scan.observation.noise  # noisier scans leave larger residuals
        noise = next((level for level in NOISES if level >= least), NOISES[-1])
        power = np.clip(round(np.log2(scan.count)), 6, 16)
        return cls(scan.kind, 0 if scan.kind == "view" else int(2**power), noise)

    def __str__(self) -> str:
        count = f", {self.count} points" if self.count else ""
        return f"{self.kind}{count}" + (f", noise {self.noise:g}" if self.noise else "")

    def observations(self, shapes: Sequence[StoredShape], evidence: Evidence) -> list[ObservedScan]:
        """Simulated scans of shapes, observed in the normalised frame: one of each shape, several views."""
        observed = []
        for shape, number in product(shapes, range(VIEWS if self.kind == "view" else 1)):
            rng = np.random.default_rng([shape_seed(shape), number])
            observed.append(observe(self.scan(shape, number), evidence, NORMALIZED, rng))
        return observed

    def scan(self, shape: StoredShape, number: int = 0) -> Scan:
        """A simulated scan of a shape, in the normalised frame, by its number."""
        rng = np.random.default_rng([shape_seed(shape), number])
        if self.kind == "samples":
            rows = signed_samples(shape, None, rng).astype(np.float64)
            return Scan(rows[:, :3], sdf=rows[:, 3])
        if shape.mesh is None:
            raise SdfhubError(f"the run's data has no meshes, so that no scan ({self}) can be simulated")
        if self.kind == "view":
            for _ in range(LOOKS):
                sensor = random_sensor(rng, shape.up)
                points = view_scan(shape.mesh, sensor, PIXELS, self.noise, rng)
                if len(points) >= LEAST:  # a rod seen along its axis shows less
                    return Scan(points, sensor=sensor)
            raise SdfhubError(f"{shape.id}: is too thin to be seen from anywhere")
        points, normals = surface_scan(shape.mesh, self.count, self.noise, rng)
        return Scan(points, normals if self.kind == "oriented" else None)


def random_sensor(rng: np.random.Generator, up: UpAxis) -> np.ndarray:
    """[3] a place around the unit ball, not far above or below its middle."""
    height, turn = rng.uniform(-HEIGHT, HEIGHT), rng.uniform(0, 2 * np.pi)
    flat = np.sqrt(1 - height**2)
    x, y = flat * np.cos(turn), flat * np.sin(turn)
    return DISTANCE * np.array([x, y, height] if up == "z" else [x, height, y])


def surface_scan(
    mesh: NormalizedMesh, count: int, noise: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Points [count, 3] spread evenly over a mesh, moved by noise of that deviation, and normals there."""
    points, normals = sample_surface(mesh.vertices, mesh.faces, count, rng)
    return points + noise * rng.standard_normal(points.shape), normals


def view_scan(
    mesh: NormalizedMesh, sensor: np.ndarray, pixels: int, noise: float, rng: np.random.Generator
) -> np.ndarray:
    """Points [M, 3] that a sensor [3] outside the unit ball sees; noise: the deviation along the rays."""
    right = np.cross(-sensor, np.eye(3)[np.abs(sensor).argmin()])
    right /= np.linalg.norm(right)
    _, rays, hits = seen_from(sensor, right, HALF_VIEW, pixels, mesh.vertices, mesh.faces)
    seen = hits["primID"] >= 0
    depth = hits["tfar"][seen] + noise * rng.standard_normal(seen.sum())
    return sensor + depth[:, None] * rays[seen].astype(np.float64)
