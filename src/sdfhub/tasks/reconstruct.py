"""Task `reconstruct`: the shapes behind scans, found in a trained space, as meshes in the scans' frames."""

import logging
import sys
from collections import Counter
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from omegaconf import DictConfig
from pydantic import Field
from tqdm import tqdm

from sdfhub.composition import instantiate, plain
from sdfhub.data.sources.source import unique_ids
from sdfhub.data.splits import Split, split
from sdfhub.data.store.stored_shape import StoredShape
from sdfhub.described import check
from sdfhub.errors import SdfhubError
from sdfhub.opening import beside, load
from sdfhub.reconstruction.calibration import Calibration
from sdfhub.reconstruction.reconstructor import Limits, Reconstructor, Result, is_result, table
from sdfhub.scans.observed_scan import ObservedScan, ScanFrame
from sdfhub.scans.scan import FORMATS
from sdfhub.scans.simulated import ScanKind
from sdfhub.shapes import NORMALIZED
from sdfhub.space import Space
from sdfhub.tasks.evaluate import data_again
from sdfhub.whole_file import refuse_unwritable

log = logging.getLogger(__name__)

PARTS = ("fit", "evidence", "calibration")  # beside `poses`, what decides when a fit is doubtful


def scan_files(wanted: str | Sequence[str]) -> dict[str, Path]:
    """The files to read, those of a folder included, by the names of their results."""
    scans: dict[Path, None] = {}
    for path in map(Path, [wanted] if isinstance(wanted, str) else wanted):
        inside = sorted(file for file in path.rglob("*") if file.is_file() and not is_result(file))
        if others := {file.suffix.lower() or file.name for file in inside}.difference(FORMATS):
            log.warning("scans=%s: passes over what is no scan: %s", path, " ".join(sorted(others)))
        scans |= dict.fromkeys(file for file in inside if file.suffix.lower() in FORMATS)
        scans |= {} if path.is_dir() else {path: None}
    if not scans:
        raise SdfhubError(f"scans={wanted}: holds no scans ({' '.join(FORMATS)})")
    count = Counter(path.stem for path in scans)
    return unique_ids({p: p.stem if count[p.stem] == 1 else p.name.replace(".", "-") for p in scans})


def parts(config: DictConfig, space: Space) -> tuple[Reconstructor, Calibration]:
    """What the config names, made: how scans are fitted in a space, and how limits are found."""
    frame = scan_frame(space, config["frame"], check(config["of"], str | int | None, "of"))
    poses = instantiate(config.poses, "poses", up=space.up)
    fit, evidence, calibration = (instantiate(config[name], name) for name in PARTS)
    resolution = check(config["resolution"], Annotated[int, Field(ge=2)], "resolution")
    poses = poses if frame == "unknown" else None
    return Reconstructor(space, fit, evidence, frame, poses, resolution), calibration


def scan_frame(space: Space, frame: Any, of: str | int | None) -> ScanFrame:
    """Where scans lie; `source` is the frame of the source of shape `of`, None where all shapes lie alike."""
    check(frame, Literal["shape", "normalised", "source", "unknown"], "frame")
    if frame != "source":
        if of is not None:
            raise SdfhubError(f"of={of}: needs frame=source")
        return NORMALIZED if frame == "normalised" else frame
    if of is not None:
        id = space.ids[space.row(of)]
        if id not in space.frames:
            raise SdfhubError(f"of={of}: the run does not know where {id} lies in its source's frame")
        return space.frames[id]
    frames = {(*map(float, known.center), known.scale): known for known in space.frames.values()}
    if len(frames) != 1:
        raise SdfhubError("frame=source: shapes of this run lie differently; name one with of=ID")
    return next(iter(frames.values()))


def unseen_shapes(run: Path, config: DictConfig, count: int) -> list[StoredShape]:
    """Up to `count` shapes that a run was not trained on: its held-out ones, then others of its source."""
    data, roles = data_again(run, config)[1:]
    offered = {shape.id: shape for shape in data.source.shapes()}
    first = [offered.pop(id) for id in roles["held_out"] if id in offered]
    rest = [s for id, s in offered.items() if id not in roles["train"] and s.split != "train"]
    rest, first = [shape for shape in rest if shape.split == "held_out"] or rest, first[:count]
    more = split(rest, 0, min(count - len(first), len(rest)), seed=0).held_out
    return list(data.filled(Split([], first + more)).values())


def limits_of(
    run: Path, scans: Reconstructor, calibration: Calibration, kinds: Sequence[ScanKind], config: DictConfig
) -> dict[ScanKind, Limits]:
    """The limits for kinds of scans; none, and a line that says why, where they cannot be had."""
    if not calibration.shapes:
        return {}
    settings: dict[str, Any] = {key: plain(config[key]) for key in PARTS}
    settings["poses"] = plain(config.poses) if scans.poses else None
    try:
        return calibration.limits(run, settings, kinds, scans, partial(unseen_shapes, run, config))
    except (SdfhubError, OSError, LookupError, TypeError) as error:  # an older run may lack anything
        log.warning("no verdicts: %s", error)
        return {}


def reconstruct_run(config: DictConfig) -> list[Result]:
    """Finds the shapes behind `scans`, as `config` (conf/reconstruct.yaml) says."""
    run, settings = Path(str(config.run)), plain(config)
    out = beside(str(run), config.out, "reconstructions")
    sensor = check(settings["sensor"], tuple[float, float, float] | None, "sensor")
    together = check(settings["together"], Annotated[int, Field(ge=1)], "together")
    files = scan_files(check(settings["scans"], str | list[str], "scans"))
    for name, path in files.items():
        mesh = out / f"{name}.ply"
        if mesh.resolve() == path.resolve() or (mesh.exists() and not is_result(mesh)):
            raise SdfhubError(f"out={out}: the result of {path} would overwrite {mesh}")
    reconstructor, calibration = parts(config, load(run, trust=config.trust or ()))
    refuse_unwritable(out)
    scans, results = dict[str, ObservedScan](), list[Result]()
    for name, path in tqdm(files.items(), desc="reading", unit="scan", leave=False, disable=None):
        try:
            scans[name] = reconstructor.read(path, sensor)
        except SdfhubError as error:
            results.append(Result(name, reason=str(error)))
    kinds = list(dict.fromkeys(map(ScanKind.of, scans.values())))
    limits = limits_of(run, reconstructor, calibration, kinds, config) if scans else {}
    together = 1 if reconstructor.space.device.type == "cpu" else together
    made = reconstructor.reconstruct(scans, limits, out, together)
    results += tqdm(made, total=len(scans), desc="fitting", unit="scan", leave=False, disable=None)
    failed = [result for result in results if result.verdict == "failed"]
    if len(failed) < len(results):
        print(f"{table(results)}\n\nmeshes and codes: {out}")
    for result in failed:
        # the result of an earlier command for a scan of this name stays
        if len(failed) < len(results) and not (out / f"{result.name}.json").exists():
            result.write(out)
        print(f"sdfhub: error: {result.reason}", file=sys.stderr)
    return results


def reconstruct(config: DictConfig) -> None:
    """The task: `config` as conf/reconstruct.yaml has it."""
    if any(result.verdict == "failed" for result in reconstruct_run(config)):
        sys.exit(1)
