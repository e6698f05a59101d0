"""Unseen shapes from scans of every kind: how good, how honest, how fast.

    python benchmarks/reconstruction.py --space RUN [--kinds samples oriented] [--shapes 8] [--strangers 6]
        [--reference 2] [--sheet sheet.png] [overrides of conf/reconstruct.yaml]

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
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from hydra import compose, initialize_config_dir
from runs import at_least, run_benchmark
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from sdfhub.scans.target import Target, observed
from sdfhub.tasks.calibration import Alike, Limits, unseen_shapes
from sdfhub.tasks.reconstructor import Found, Reconstructor

from sdfhub.data.sources import ProceduralSource
from sdfhub.data.splits import split
from sdfhub.data.store.store import prepare, shape_seed
from sdfhub.data.store.stored_shape import StoredShape
from sdfhub.geometry.contact_sheet import contact_sheet
from sdfhub.geometry.mesher import Mesh
from sdfhub.geometry.metrics import judge, point_to_surface
from sdfhub.geometry.render import render
from sdfhub.geometry.surface_sampling import sample_surface
from sdfhub.scans.scan import Scan
from sdfhub.tasks.app import register_resolvers
from sdfhub.tasks.build import build, plain
from sdfhub.tasks.conf_files import configuration_folder
from sdfhub.tasks.reconstruct import limits_of, reconstructor
from sdfhub.tasks.run import read_run

KINDS = {
    "samples": Alike("samples", 0, 0.0),
    "oriented": Alike("oriented", 8192, 0.0),
    "bare": Alike("bare", 8192, 0.0),
    "noisy": Alike("bare", 8192, 0.01),
    "view": Alike("view", 0, 0.0),
    "turned": Alike("oriented", 8192, 0.0),
    "turned view": Alike("view", 0, 0.0),
}
TILT = 10.0
"""Degrees by which the upright axis of turned scans is off at most."""
SEEN = 0.02
"""Distance to a scan point within which a true surface point counts as seen."""


def prepared_lamps(count: int, trained: dict) -> list[StoredShape]:
    source = ProceduralSource({"lamps": {}})
    preparation = build(trained["data"]["preparation"], "data.preparation", within="sdfhub.data")
    shapes = split(source.shapes(), 0, count, seed=4).held_out
    return list(prepare(source, shapes, preparation, Path(trained["data"]["store"]), workers=1).values())


def moved(scan: Scan, shape: StoredShape) -> tuple[Scan, np.ndarray]:
    """A scan in a frame that nobody knows, and the matrix [4, 4] back from there."""
    rng = np.random.default_rng(shape_seed(shape))
    lie = Rotation.from_euler("x" if shape.up == "z" else "z", rng.uniform(-TILT, TILT), degrees=True)
    yaw = Rotation.from_euler(shape.up, rng.uniform(0, 360), degrees=True)
    matrix = np.eye(4)
    matrix[:3, :3] = rng.uniform(0.1, 10) * (lie * yaw).as_matrix()
    matrix[:3, 3] = rng.uniform(-5, 5, 3)
    turn = None if scan.normals is None else scan.normals @ (lie * yaw).as_matrix().T
    sensor = None if scan.sensor is None else applied(matrix, scan.sensor)
    there = replace(scan, points=applied(matrix, scan.points), normals=turn, sensor=sensor)
    return there, np.linalg.inv(matrix)


def applied(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def targets_of(
    how: Reconstructor, kind: Alike, shapes: list[StoredShape]
) -> tuple[list[Target], list[np.ndarray]]:
    """What is observed of shapes, and the matrices from the scans' frames to the normalised one."""
    if how.poses is None:
        return [kind.target(each, how.evidence) for each in shapes], [np.eye(4)] * len(shapes)
    scans = [moved(kind.scan(each), each) for each in shapes]
    rngs = [np.random.default_rng(shape_seed(each)) for each in shapes]
    found = [observed(scan, how.evidence, "unknown", rng) for (scan, _), rng in zip(scans, rngs, strict=True)]
    return found, [matrix for _, matrix in scans]


def fit_all(
    how: Reconstructor, kind: Alike, shapes: list[StoredShape]
) -> tuple[list[Mesh], list[Found], float]:
    """Mesh of each shape, in the normalised frame, residual and doubt, and processor seconds a fit."""
    targets, matrices = targets_of(how, kind, shapes)
    meshes, found, seconds = [], [], 0.0
    for target, matrix in zip(targets, matrices, strict=True):
        start = time.process_time()
        fitted = how.fit([target])
        seconds += time.process_time() - start
        (vertices, faces), _ = next(how.meshes([target], fitted))
        near = how.poses is None or bool(how.poses.holds(fitted.poses))
        meshes.append((applied(matrix, vertices), faces))
        doubt = float(how.doubts(fitted)) if near else np.inf
        found.append(Found("", residual=float(fitted.residuals), doubt=doubt, mesh="m"))
    return meshes, found, seconds / max(1, len(targets))


def excesses(shapes: list[StoredShape], meshes: list[Mesh]) -> np.ndarray:
    found = [judge(mesh, shape.mesh).excess for mesh, shape in zip(meshes, shapes, strict=True)]
    return np.array([np.nan if each is None else each * 1e3 for each in found])


def judged(found: list[Found]) -> list[tuple[float, float]]:
    return [(each.residual, each.doubt) for each in found]


def right_verdicts(found: list[Found], limits: Limits | None, wanted: str) -> str:
    given = [each.judged(limits, True).verdict for each in found]
    return f"{given.count(wanted)}/{len(given)}"


def render_of(mesh: Mesh) -> np.ndarray:
    return render(*mesh, size=192) if len(mesh[1]) else "no surface"


def view_line(shapes: list[StoredShape], kind: Alike, meshes: list[Mesh]) -> str:
    """Distances of the true surface to the reconstruction, where it was seen and where not."""
    sides: dict[str, list[float]] = {"seen": [], "unseen": []}
    for shape, mesh in zip(shapes, meshes, strict=True):
        truth, _ = sample_surface(shape.mesh.vertices, shape.mesh.faces, 10_000, 0)
        is_seen = cKDTree(kind.scan(shape).points).query(truth)[0] < SEEN
        distance = point_to_surface(truth, *mesh) * 1e3
        sides["seen"].append(distance[is_seen].mean())
        sides["unseen"].append(distance[~is_seen].mean())
    return "; ".join(f"{name} {np.median(of):.1f} (worst {max(of):.1f})" for name, of in sides.items())


def row(name: str, excess: np.ndarray, base: float, seconds: float, own: str = "", others: str = "") -> None:
    numbers = [np.nanmedian(excess), np.nanmean(excess), np.nanmedian(excess) / base]
    cells = [f"{value:.4f}" for value in numbers[:2]] + [f"{numbers[2]:.2f}", str(np.isnan(excess).sum())]
    print(f"| {name} | {' | '.join([*cells, own, others, f'{seconds:.1f}'])} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--space", type=Path, required=True, help="folder of a trained run")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--shapes", type=at_least(1), default=8)
    parser.add_argument("--strangers", type=at_least(0), default=6)
    parser.add_argument(
        "--reference", type=at_least(0), default=0, help="shapes also fitted by DeepSDF's recipe"
    )
    parser.add_argument("--base", type=float, help="median excess from samples, where these are not run")
    parser.add_argument("--sheet", type=Path, help="PNG: the truth above its reconstructions")
    arguments, overrides = parser.parse_known_args()
    torch.set_num_threads(1)
    compare(arguments, overrides)


def configured(run: Path, overrides: list[str], method: str) -> dict:
    register_resolvers()
    with initialize_config_dir(str(configuration_folder()), version_base="1.3"):
        common = [f"run={run}", "target=-", "frame=normalised", f"method={method}"]
        return plain(compose("reconstruct", common + overrides))


def compare(arguments: argparse.Namespace, overrides: list[str]) -> None:
    run, still = arguments.space, configured(arguments.space, overrides, "map")
    turned = configured(arguments.space, [*overrides, "frame=unknown"], "map")
    trained, roles = read_run(run)
    first = still["calibration"]["shapes"]
    shapes = unseen_shapes(trained, roles, still["data"], first + arguments.shapes)[first:]
    strangers = prepared_lamps(arguments.strangers, trained)
    head = "| scan | excess median | mean | ratio | no surface | own fitted | strangers doubtful | s |"
    print(f"{head}\n{'| --- ' * 8}|", flush=True)
    base, sheet = arguments.base or np.nan, {"truth": [render_of(truth_of(each)) for each in shapes]}
    for name in arguments.kinds:
        kind, config = KINDS[name], turned if "turned" in name else still
        how = reconstructor(run, config)
        limits = limits_of(run, how, [kind], config).get(kind)
        meshes, own, seconds = fit_all(how, kind, shapes)
        _, others, _ = fit_all(how, kind, strangers)
        excess = excesses(shapes, meshes)
        base = np.nanmedian(excess) if name == "samples" else base
        right = right_verdicts(own, limits, "fitted"), right_verdicts(others, limits, "doubtful")
        row(name, excess, base, seconds, *right)
        lists = {"excess": excess, "own": judged(own), "strangers": judged(others)}
        said = "; ".join(f"{key} {np.round(values, 5).tolist()}" for key, values in lists.items())
        print(f"{name}: {limits}; {said}", file=sys.stderr, flush=True)
        if "view" in name:
            print(f"\n{name}, true surface to reconstruction: {view_line(shapes, kind, meshes)}\n")
        sheet[name] = list(map(render_of, meshes))
        if arguments.reference and name in ("samples", "oriented"):
            compare_with_deepsdf(arguments, overrides, kind, shapes, excess, base)
    if arguments.sheet:
        contact_sheet(list(sheet.values()), list(sheet), [each.id for each in shapes], arguments.sheet)


def compare_with_deepsdf(
    arguments: argparse.Namespace,
    overrides: list[str],
    kind: Alike,
    shapes: list[StoredShape],
    excess: np.ndarray,
    base: float,
) -> None:
    count = arguments.reference
    rival = reconstructor(arguments.space, configured(arguments.space, overrides, "deepsdf"))
    theirs, _, seconds = fit_all(rival, kind, shapes[:count])
    row(f"{kind.kind}, first {count}", excess[:count], base, np.nan)
    other = excesses(shapes[:count], theirs)
    row(f"{kind.kind}, first {count}, DeepSDF's recipe", other, base, seconds)


def truth_of(shape: StoredShape) -> Mesh:
    mesh = shape.mesh
    return mesh.vertices, mesh.faces


if __name__ == "__main__":
    run_benchmark(main)
