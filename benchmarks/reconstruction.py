"""Unseen shapes from scans of every kind: how good, how honest, how fast.

    python benchmarks/reconstruction.py --space RUN [--kinds samples oriented] [--shapes 8] [--strangers 6]
        [--reference 2] [--sheet sheet.png] [overrides of conf/reconstruct.yaml]

Shapes: of the space's source, neither trained on nor calibrated with. Kinds: signed samples; 8192 points with
normals; the same bare; the same with noise of 0.5% of the size (0.01: in the normalised frame, shapes are
some 2 long); one view of 100 x 100 rays, from a known place. All in the normalised frame. Strangers: lamps,
scanned alike; the right verdict is `fitted` on the space's own kind, `doubtful` on them. CD: meshes at 128^3,
30,000 points a side, excess over the noise floor, times 10^3; ratio: of medians, to signed samples. Seconds:
of the processor, one thread, fitting alone. With --reference also DeepSDF's recipe on the first shapes, from
signed samples and from the oriented cloud (whose tight bounds are its samples). Of views also the distance of
the true surface to the reconstruction, times 10^3: median of shapes, where seen (within 0.02 of a scan point)
and where not.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np
import torch
from hydra import compose, initialize_config_dir
from scipy.spatial import cKDTree

from sdfhub.data.shards import StoredShape
from sdfhub.data.sources import ProceduralSource
from sdfhub.data.splits import Split, split
from sdfhub.data.target import Target
from sdfhub.geometry.contact_sheet import contact_sheet
from sdfhub.geometry.mesher import Mesh
from sdfhub.geometry.metrics import judge, point_to_surface, sample_surface
from sdfhub.geometry.render import render
from sdfhub.tasks.app import configuration_folder, register_resolvers
from sdfhub.tasks.build import build, plain
from sdfhub.tasks.calibration import Alike, unseen_shapes
from sdfhub.tasks.prepare import stored_split
from sdfhub.tasks.reconstruct import reconstructor, thresholds_of
from sdfhub.tasks.reconstructor import Found, Reconstructor
from sdfhub.tasks.run import read_run

KINDS = {
    "samples": Alike("samples", 0, 0.0),
    "oriented": Alike("oriented", 8192, 0.0),
    "bare": Alike("bare", 8192, 0.0),
    "noisy": Alike("bare", 8192, 0.01),
    "view": Alike("view", 0, 0.0),
}
SEEN = 0.02
"""Distance to a scan point within which a true surface point counts as seen."""


def prepared_lamps(count: int, trained: dict) -> list[StoredShape]:
    source = ProceduralSource({"lamps": {}})
    preparation = build(trained["data"]["preparation"], "data.preparation", within="sdfhub.data")
    chosen = Split([], split(source.shapes(), 0, count, seed=0).test)
    return stored_split(source, chosen, preparation, trained["data"] | {"workers": 1}).held_out


def fit_all(how: Reconstructor, targets: list[Target]) -> tuple[list[tuple[Mesh, float]], float]:
    """Mesh of each target and doubt about it, and processor seconds a fit."""
    found, seconds = [], 0.0
    for target in targets:
        start = time.process_time()
        fitted = how.fit([target])
        seconds += time.process_time() - start
        mesh, _ = next(how.meshes([target], fitted))
        found.append((mesh, float(how.doubts_about(fitted))))
    return found, seconds / max(1, len(targets))


def excesses(shapes: list[StoredShape], meshes: list[Mesh]) -> np.ndarray:
    found = [judge(mesh, shape.mesh).excess for mesh, shape in zip(meshes, shapes, strict=True)]
    return np.array([np.nan if each is None else each * 1e3 for each in found])


def right_verdicts(doubts: list[float], threshold: float | None, wanted: str) -> str:
    given = [Found("", doubt=each, mesh="m").judged(threshold, True).verdict for each in doubts]
    return f"{given.count(wanted)}/{len(given)}"


def render_of(mesh: Mesh) -> np.ndarray:
    return render(*mesh, size=192) if len(mesh[1]) else None


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
    parser.add_argument("--shapes", type=int, default=8)
    parser.add_argument("--strangers", type=int, default=6)
    parser.add_argument("--reference", type=int, default=0, help="shapes also fitted by DeepSDF's recipe")
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
    run, config = arguments.space, configured(arguments.space, overrides, "map")
    trained, roles = read_run(run)
    how = reconstructor(run, config)
    first = config["calibration"]["shapes"]
    shapes = unseen_shapes(trained, roles, config["data"], first + arguments.shapes)[first:]
    strangers = prepared_lamps(arguments.strangers, trained)
    head = "| scan | excess median | mean | ratio | no surface | own fitted | strangers doubtful | s |"
    print(f"{head}\n{'| --- ' * 8}|", flush=True)
    base, sheet = arguments.base or np.nan, {"truth": [render_of(truth_of(each)) for each in shapes]}
    for name in arguments.kinds:
        kind = KINDS[name]
        threshold = thresholds_of(run, how, [kind], config).get(kind)
        own, seconds = fit_all(how, [kind.target(each, how.evidence) for each in shapes])
        others, _ = fit_all(how, [kind.target(each, how.evidence) for each in strangers])
        meshes, doubts, strange = [m for m, _ in own], [r for _, r in own], [r for _, r in others]
        excess = excesses(shapes, meshes)
        base = np.nanmedian(excess) if name == "samples" else base
        right = right_verdicts(doubts, threshold, "fitted"), right_verdicts(strange, threshold, "doubtful")
        row(name, excess, base, seconds, *right)
        lists = {"excess": excess, "doubts": doubts, "strangers": strange}
        said = "; ".join(f"{key} {np.round(values, 5).tolist()}" for key, values in lists.items())
        print(f"{name}: threshold {threshold}; {said}", file=sys.stderr, flush=True)
        if name == "view":
            print(f"\nview, true surface to reconstruction: {view_line(shapes, kind, meshes)}\n")
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
    theirs, seconds = fit_all(rival, [kind.target(each, rival.evidence) for each in shapes[:count]])
    row(f"{kind.kind}, first {count}", excess[:count], base, np.nan)
    other = excesses(shapes[:count], [mesh for mesh, _ in theirs])
    row(f"{kind.kind}, first {count}, DeepSDF's recipe", other, base, seconds)


def truth_of(shape: StoredShape) -> Mesh:
    mesh = shape.mesh
    return mesh.vertices, mesh.faces


if __name__ == "__main__":
    main()
