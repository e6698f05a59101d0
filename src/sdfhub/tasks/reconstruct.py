"""Task `reconstruct`: the shapes behind scans, found in a trained space, as meshes in the scans' frames."""

import json
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from omegaconf import DictConfig
from pydantic import Field
from tqdm import tqdm

from sdfhub.data.sources.source import unique_ids
from sdfhub.errors import SdfhubError
from sdfhub.scans.scan import FORMATS
from sdfhub.scans.target import FrameKind, Target
from sdfhub.tasks.app import run_task
from sdfhub.tasks.build import build, check, plain
from sdfhub.tasks.calibration import Alike, Limits, calibrated
from sdfhub.tasks.opening import beside, clamp, load
from sdfhub.tasks.reconstructor import Found, Reconstructor, reconstruct_targets, table, write_found
from sdfhub.tasks.run import leave_no_empty_folder, read_run, refuse_unwritable


def scan_files(wanted: str | Sequence[str]) -> dict[str, Path]:
    """The files to read, those of a folder included, by the names of their results.

    Raises:
        SdfhubError: a folder holds no scans, or nothing is named.
    """
    named: dict[Path, str] = {}
    for path in map(Path, [wanted] if isinstance(wanted, str) else wanted):
        inside = [path]
        if path.is_dir():
            files = sorted(each for each in path.rglob("*") if each.is_file())
            files = [each for each in files if not is_result(each)]
            inside = [each for each in files if each.suffix.lower() in FORMATS]
            if not inside:
                raise SdfhubError(f"target={path}: holds no scans ({' '.join(FORMATS)})")
            if others := sorted({each.suffix.lower() or each.name for each in set(files) - set(inside)}):
                print(f"target={path}: passes over what is no scan: {' '.join(others)}", file=sys.stderr)
        named |= {each: each.stem for each in inside}
    if not named:
        raise SdfhubError("target: names no scan")
    often = Counter(named.values())
    return unique_ids(
        {path: stem if often[stem] == 1 else path.name.replace(".", "-") for path, stem in named.items()}
    )


def is_result(path: Path) -> bool:
    """Whether a mesh is what an earlier command found of a scan: the JSON beside it says so."""
    try:
        said = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(said, dict) and "verdict" in said and said.get("mesh") == path.name


def read_targets(
    how: Reconstructor, files: dict[str, Path], sensor: Sequence[float] | None
) -> tuple[dict[str, Target], list[Found]]:
    """What the files observe, by name, and those that cannot be used."""
    targets, failed = {}, []
    for name, path in tqdm(files.items(), desc="reading", unit="scan", leave=False, disable=None):
        try:
            targets[name] = how.target(path, sensor)
        except SdfhubError as error:
            failed.append(Found(name, reason=str(error)))
    return targets, failed


def reconstructor(run: Path, config: dict[str, Any]) -> Reconstructor:
    """The space of a run or an exported file, and how it is to be used."""
    frame = check(config["frame"], FrameKind, "frame")
    space = load(run)
    prior = build(config["prior"], "prior", within="sdfhub.latent")
    poses = build(config["poses"], "poses", within="sdfhub.latent", up=space.up)
    return Reconstructor(
        space,
        likely=prior(space.codes),
        method=build(config["method"], "method", within="sdfhub.latent", delta=clamp(space.config)),
        evidence=build(config["evidence"], "evidence", within="sdfhub.scans"),
        frame=frame,
        poses=poses if frame == "unknown" else None,
        resolution=check(config["resolution"], Annotated[int, Field(ge=2)], "resolution"),
    )


def limits_of(
    run: Path, how: Reconstructor, kinds: Sequence[Alike], config: dict[str, Any]
) -> dict[Alike, Limits]:
    """The limits for kinds of scans; none, and a line that says why, where they cannot be had."""
    calibration = build(config["calibration"], "calibration")
    if not calibration.shapes:
        return {}
    settings = {key: config[key] for key in ("method", "prior", "evidence", "calibration")}
    settings["poses"] = config["poses"] if how.poses else None
    try:
        trained, roles = read_run(run)
        return calibrated(run, trained, roles, calibration, kinds, how, settings, config["data"])
    except (SdfhubError, OSError, LookupError, TypeError) as error:  # whatever an older run lacks
        print(f"no verdicts: {error}", file=sys.stderr)
        return {}


def reconstruct_run(config: dict[str, Any]) -> list[Found]:
    """Finds the shapes behind what `target` names, as `config` (conf/reconstruct.yaml) says."""
    run = Path(check(config["run"], str, "run"))
    out = beside(str(run), check(config["out"], str | None, "out"), "reconstructions")
    sensor = check(config["sensor"], tuple[float, float, float] | None, "sensor")
    together = check(config["together"], Annotated[int, Field(ge=1)], "together")
    files = scan_files(check(config["target"], str | list[str], "target"))
    for name, path in files.items():
        result = out / f"{name}.ply"
        if result.resolve() == path.resolve() or (result.exists() and not is_result(result)):
            raise SdfhubError(
                f"out={out}: the result of {path} would overwrite {result}; choose another folder"
            )
    how = reconstructor(run, config)
    refuse_unwritable(out)
    targets, results = read_targets(how, files, sensor)
    kinds = list(dict.fromkeys(map(Alike.to, targets.values())))
    limits = limits_of(run, how, kinds, config) if targets else {}
    together = 1 if how.space.device.type == "cpu" else together
    found = reconstruct_targets(how, targets, limits, out, together)
    results += tqdm(found, total=len(targets), desc="fitting", unit="scan", leave=False, disable=None)
    failed = [each for each in results if each.verdict == "failed"]
    if len(failed) < len(results):
        print(f"{table(results)}\n\nmeshes and codes: {out}")
    else:
        leave_no_empty_folder(out)
    for each in failed:
        # what an earlier command found of a scan of this name stays
        if len(failed) < len(results) and not (out / f"{each.name}.json").exists():
            write_found(each, out)
        print(f"sdfhub: error: {each.reason}", file=sys.stderr)
    return results


def main() -> None:
    """Console entry: `sdfhub reconstruct run=RUN target=scan.ply`. Exit status 1 if a scan failed."""

    def task(config: DictConfig) -> None:
        if any(found.verdict == "failed" for found in reconstruct_run(plain(config))):
            sys.exit(1)

    run_task(task, "reconstruct")
