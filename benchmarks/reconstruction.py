"""Unseen shapes from scans of every kind: how good, how honest, how fast.

    python benchmarks/reconstruction.py --space RUN [--kinds samples oriented] [--shapes 8] [--strangers 6]
        [--reference 2] [overrides of conf/reconstruct.yaml]

Shapes: of the space's source, neither trained on nor calibrated with. Kinds: signed samples; 8192 points with
normals; the same bare; the same with noise of 0.5% of the size (0.01: in the normalised frame, shapes are
some 2 long); one view of 100 x 100 rays, from a known place; all in the normalised frame. Then the cloud with
normals and the view again, `turned`: about the upright axis by any angle, tilted by up to 10 degrees, of any
size and place, fitted with frame=unknown; their meshes are judged back in the normalised frame. Strangers:
lamps, scanned alike; the right verdict is `fitted` on the space's own kind, `doubtful` on them. CD: meshes at
256^3, 30,000 points a side, excess over the noise floor, times 10^3; ratio: of medians, to signed samples.
Seconds: of the processor, one thread, fitting alone. With --reference also DeepSDF's recipe on the first
shapes, from signed samples and from the oriented cloud (whose tight bounds are its samples). Of views also
the distance of the true surface to the reconstruction, times 10^3: median of shapes, where seen (within 0.02
of a scan point) and where not.
"""

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig
from runs import head, row
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import sdfhub
from sdfhub.composition import configuration_folder
from sdfhub.data.sources import ProceduralSource
from sdfhub.data.splits import split
from sdfhub.data.store.store import prepare, shape_seed
from sdfhub.data.store.stored_shape import StoredShape
from sdfhub.geometry.metrics import judge, point_to_surface
from sdfhub.geometry.surface import sample_surface
from sdfhub.opening import data_of, read_run
from sdfhub.reconstruction.reconstructor import Limits, Reconstructor, Result
from sdfhub.scans.observed_scan import ObservedScan, observe
from sdfhub.scans.scan import Scan
from sdfhub.scans.simulated import ScanKind
from sdfhub.shapes import Mesh
from sdfhub.tasks.reconstruct import limits_of, parts, unseen_shapes

KINDS = {
    "samples": ScanKind("samples"),
    "oriented": ScanKind("oriented", 8192),
    "bare": ScanKind("bare", 8192),
    "noisy": ScanKind("bare", 8192, 0.01),
    "view": ScanKind("view"),
    "turned": ScanKind("oriented", 8192),
    "turned view": ScanKind("view"),
}
TILT = 10.0
"""Degrees by which the upright axis of turned scans is off at most."""
SEEN = 0.02
"""Distance to a scan point within which a true surface point counts as seen."""


class Fits(NamedTuple):
    """Reconstructions of shapes, normalised frame, their verdicts, and processor seconds a fit."""

    meshes: list[Mesh]
    results: list[Result]
    seconds: float

    def excesses(self, shapes: Sequence[StoredShape]) -> np.ndarray:
        """[S] excess CD times 10^3, NaN without a surface."""
        found = [judge(mesh, shape.mesh).excess for mesh, shape in zip(self.meshes, shapes, strict=True)]
        return np.array([np.nan if excess is None else excess * 1e3 for excess in found])

    def verdicts(self, wanted: str) -> str:
        """How many of them are as they should be."""
        return f"{sum(result.verdict == wanted for result in self.results)}/{len(self.results)}"


def prepared_lamps(count: int, run: Path) -> list[StoredShape]:
    """Lamps, prepared as the run's own shapes were."""
    source, data = ProceduralSource({"lamps": {}}), data_of(read_run(run)[0])
    shapes = split(source.shapes(), 0, count, seed=4).held_out
    return list(prepare(source, shapes, data.preparation, Path(data.store), workers=1).values())


def moved(scan: Scan, shape: StoredShape) -> tuple[Scan, np.ndarray]:
    """A scan in a frame that nobody knows, and the matrix [4, 4] back from there."""
    rng = np.random.default_rng(shape_seed(shape))
    lie = Rotation.from_euler("x" if shape.up == "z" else "z", rng.uniform(-TILT, TILT), degrees=True)
    yaw = Rotation.from_euler(shape.up, rng.uniform(0, 360), degrees=True)
    matrix = np.eye(4)
    matrix[:3, :3] = rng.uniform(0.1, 10) * (lie * yaw).as_matrix()
    matrix[:3, 3] = rng.uniform(-5, 5, 3)
    turned = None if scan.normals is None else scan.normals @ (lie * yaw).as_matrix().T
    sensor = None if scan.sensor is None else applied(matrix, scan.sensor)
    there = replace(scan, points=applied(matrix, scan.points), normals=turned, sensor=sensor)
    return there, np.linalg.inv(matrix)


def applied(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def observed(how: Reconstructor, kind: ScanKind, shape: StoredShape) -> tuple[ObservedScan, np.ndarray]:
    """A scan of a shape, and the matrix from its frame to the normalised one."""
    if how.poses is None:
        return kind.observations([shape], how.evidence)[0], np.eye(4)
    scan, back = moved(kind.scan(shape), shape)
    return observe(scan, how.evidence, "unknown", np.random.default_rng(shape_seed(shape))), back


def fit_all(
    how: Reconstructor, kind: ScanKind, shapes: Sequence[StoredShape], limits: Limits | None = None
) -> Fits:
    meshes, results, seconds = [], [], 0.0
    for shape in shapes:
        scan, back = observed(how, kind, shape)
        start = time.process_time()
        fitted = how.fitted([scan])
        seconds += time.process_time() - start
        (vertices, faces), _ = next(how.meshes([scan], fitted))
        meshes.append(Mesh(applied(back, vertices), faces))
        is_near = how.poses is None or bool(how.poses.holds(fitted.poses))
        residual, doubt = float(fitted.residuals), float(how.doubts(fitted))
        result = Result(shape.id, residual=residual, doubt=doubt, mesh="" if len(faces) else None)
        results.append(result.judged(limits, is_near))
    return Fits(meshes, results, seconds / max(1, len(shapes)))


def view_line(shapes: list[StoredShape], kind: ScanKind, meshes: list[Mesh]) -> str:
    """Distances of the true surface to the reconstruction, where it was seen and where not."""
    sides: dict[str, list[float]] = {"seen": [], "unseen": []}
    for shape, mesh in zip(shapes, meshes, strict=True):
        truth, _ = sample_surface(shape.mesh.vertices, shape.mesh.faces, 10_000, 0)
        is_seen = cKDTree(kind.scan(shape).points).query(truth)[0] < SEEN
        distance = point_to_surface(truth, *mesh) * 1e3
        sides["seen"].append(distance[is_seen].mean())
        sides["unseen"].append(distance[~is_seen].mean())
    return "; ".join(f"{name} {np.median(of):.1f} (worst {max(of):.1f})" for name, of in sides.items())


def line(name: str, excess: np.ndarray, base: float, seconds: float, own: str = "", others: str = "") -> None:
    middle, mean = np.nanmedian(excess), np.nanmean(excess)
    cells = f"{middle:.4f}", f"{mean:.4f}", f"{middle / base:.2f}", np.isnan(excess).sum()
    row(name, *cells, own, others, f"{seconds:.1f}")


def composed(run: Path, *overrides: str) -> DictConfig:
    with initialize_config_dir(str(configuration_folder()), version_base="1.3"):
        return compose("reconstruct", [f"run={run}", "scans=-", "frame=normalised", *overrides])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--space", type=Path, required=True, help="folder of a trained run")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--shapes", type=int, default=8)
    parser.add_argument("--strangers", type=int, default=6)
    parser.add_argument("--reference", type=int, default=0, help="shapes also fitted by DeepSDF's recipe")
    arguments, overrides = parser.parse_known_args()
    torch.set_num_threads(1)
    compare(arguments, overrides)


def compare(arguments: argparse.Namespace, overrides: list[str]) -> None:
    run = arguments.space
    space, still = sdfhub.load(run, "cpu"), composed(run, *overrides)
    turned = composed(run, *overrides, "frame=unknown")
    first = still.calibration.shapes
    shapes = unseen_shapes(run, still, first + arguments.shapes)[first:]
    strangers = prepared_lamps(arguments.strangers, run)
    head("scan | excess median | mean | ratio | no surface | own fitted | strangers doubtful | s")
    base = np.nan
    for name in arguments.kinds:
        kind, config = KINDS[name], turned if "turned" in name else still
        how, calibration = parts(config, space)
        limits = limits_of(run, how, calibration, [kind], config).get(kind)
        own, others = fit_all(how, kind, shapes, limits), fit_all(how, kind, strangers, limits)
        excess = own.excesses(shapes)
        base = np.nanmedian(excess) if name == "samples" else base
        line(name, excess, base, own.seconds, own.verdicts("fitted"), others.verdicts("doubtful"))
        lists = {"own": own.results, "strangers": others.results}
        pairs = {key: [(r.residual, r.doubt) for r in results] for key, results in lists.items()}
        print(f"{name}: {limits}; {pairs}; excess {excess.round(5).tolist()}", file=sys.stderr, flush=True)
        if "view" in name:
            print(f"\n{name}, true surface to reconstruction: {view_line(shapes, kind, own.meshes)}\n")
        if (count := arguments.reference) and name in ("samples", "oriented"):
            rival, _ = parts(composed(run, *overrides, "fit=deepsdf"), space)
            theirs = fit_all(rival, kind, shapes[:count])
            line(f"{name}, first {count}", excess[:count], base, np.nan)
            other = theirs.excesses(shapes[:count])
            line(f"{name}, first {count}, DeepSDF's recipe", other, base, theirs.seconds)


if __name__ == "__main__":
    main()
