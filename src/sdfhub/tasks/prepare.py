"""Task `prepare`: shapes of a source become samples in the store. Training does the same on demand."""

import logging
import re

from omegaconf import DictConfig

from sdfhub.composition import instantiate
from sdfhub.errors import SdfhubError

log = logging.getLogger(__name__)


def prepare(config: DictConfig) -> None:
    """Prepares the shapes that `data` asks for, or the i-th of n parts of them, which `part=i/n` names."""
    data = instantiate(config.data, "data")
    if config.part is None:
        data.prepared(data.split)
        return
    numbers = re.fullmatch(r"(\d+)/(\d+)", str(config.part))
    i, n = map(int, numbers.groups()) if numbers else (0, 0)
    if not 1 <= i <= n:
        raise SdfhubError(f"part={config.part}: must be i/n with 1 <= i <= n, as in -m part=1/4,2/4,3/4,4/4")
    shapes, made = data.prepare_part(i, n)
    log.info("part %s: %d shapes, %d of them prepared now", config.part, shapes, made)
