"""Task `neighbours`: the known shapes whose codes are nearest to that of one of them, or of a scan."""

from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from sdfhub.errors import SdfhubError
from sdfhub.scans.scan import read_scan
from sdfhub.tasks.app import run_task
from sdfhub.composition import plain
from sdfhub.described import check
from sdfhub.tasks.gallery import write_gallery
from sdfhub.opening import beside, load
from sdfhub.tasks.words import take_words


def neighbours(config: dict[str, Any]) -> None:
    """The task: `config` as conf/neighbours.yaml has it."""
    run, shape = check(config["run"], str, "run"), check(config["of"], str | int, "of")
    out = check(config["out"], str | None, "out")
    resolution = check(config["resolution"], int, "resolution")
    space = load(run)
    if Path(str(shape)).is_file():
        of, scan = Path(str(shape)).name, read_scan(Path(str(shape)))
        if scan.kind == "view":
            raise SdfhubError(f"of={shape}: is a single view; see `sdfhub reconstruct`, which takes such")
        shape = space.fit_scan(scan)
    else:
        of = space.ids[space.row(shape)]
    found = space.neighbours(shape, check(config["k"], int, "k"))
    for id, distance in found:
        print(f"{id:<40} {distance:.4f}")
    captions = [f"of {of}", *(f"{id}\n{distance:.3f}" for id, distance in found)]
    codes = space.code([shape, *(id for id, _ in found)])
    write_gallery(space, codes, captions, beside(run, out, f"neighbours/{of.replace('/', '-')}"), resolution)


def main() -> None:
    """Console entry: `sdfhub neighbours RUN OF k=7`."""
    take_words("run", "of")

    def task(config: DictConfig) -> None:
        neighbours(plain(config))

    run_task(task, "neighbours")
