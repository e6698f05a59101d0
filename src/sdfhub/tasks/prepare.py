"""Task `prepare`: shapes of a source become samples in the store. Training does the same on demand."""

import logging
import re
from typing import Any

from omegaconf import DictConfig

from sdfhub.data.loading import SdfDataModule
from sdfhub.errors import SdfhubError
from sdfhub.tasks.app import run_task
from sdfhub.tasks.build import build, plain

log = logging.getLogger(__name__)


def prepare(config: dict[str, Any]) -> None:
    """Prepares the shapes that a config's `data` group asks for, or the part of them that `part` names.

    Args:
        config: plain; `part` is None or `i/n`, the i-th of n parts, 1 <= i <= n.
    """
    data: SdfDataModule = build(config["data"], "data", within="sdfhub.data")
    if config["part"] is None:
        data.prepared(data.split)
        return
    part = str(config["part"])
    numbers = re.fullmatch(r"(\d+)/(\d+)", part)
    i, n = map(int, numbers.groups()) if numbers else (0, 0)
    if not 1 <= i <= n:
        raise SdfhubError(f"part={part}: must be i/n with 1 <= i <= n, such as part=1/4,2/4,3/4,4/4 with -m")
    own, made = data.prepare_part(i, n)
    log.info(f"part {part}: {own} shapes, {made} of them prepared now")


def main() -> None:
    """Console entry: `sdfhub prepare data=open category=chairs data.shapes=null`."""

    def task(config: DictConfig) -> None:
        prepare(plain(config))

    run_task(task, "prepare")
