"""Task `neighbours`: the training shapes whose codes are nearest to that of one of them, or of a scan."""

from pathlib import Path

from omegaconf import DictConfig

from sdfhub.errors import SdfhubError
from sdfhub.opening import beside, load
from sdfhub.scans.scan import read_scan
from sdfhub.tasks.gallery import write_gallery


def neighbours(config: DictConfig) -> None:
    """The task: `config` as conf/neighbours.yaml has it."""
    space, shape = load(config.run, trust=config.trust or ()), config.of
    if Path(str(shape)).is_file():
        name, scan = Path(str(shape)).name, read_scan(Path(str(shape)))
        if scan.kind == "view":
            raise SdfhubError(f"of={shape}: is a single view; see `sdfhub reconstruct`, which takes such")
        shape = space.fit_scan(scan)
    else:
        name = space.ids[space.row(shape)]
    nearest = space.neighbours(shape, config.k)
    for id, distance in nearest:
        print(f"{id:<40} {distance:.4f}")
    captions = [f"of {name}", *(f"{id}\n{distance:.3f}" for id, distance in nearest)]
    codes = space.code([shape, *(id for id, _ in nearest)])
    folder = beside(config.run, config.out, f"neighbours/{name.replace('/', '-')}")
    write_gallery(space, codes, captions, folder, config.resolution)
