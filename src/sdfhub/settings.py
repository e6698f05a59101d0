"""A run's settings as plain data: by dotted key, and as a digest that tells results apart."""

import hashlib
import json
from typing import Any

WHERE_NOT_WHAT = (
    "ckpt_path",
    "output_root",
    "callbacks.",
    "checkpoint.",
    "data.store",
    "data.workers",
    "logger.",
)
WHERE_NOT_WHAT += ("data.loader.workers", "data.loader.resident", "search.")
WHERE_NOT_WHAT += ("computing.points_at_once", "computing.compile", "computing.tinycudann")
WHERE_NOT_WHAT += ("evaluate.workers", "evaluate.fit_together", "evaluate.pictures", "trainer.enable_")
WHERE_NOT_WHAT += ("trainer.log_every_n_steps", "trainer.accelerator", "trainer.devices")
WHERE_NOT_WHAT += ("trainer.strategy", "trainer.num_nodes", "validation.")
"""Settings that say where and how watched a cell runs; its result is the same under any of them."""


OF_THE_SEED = ("seed", "data.loader.seed")
"""Settings that follow from the seed."""


def settings_digest(config: dict[str, Any]) -> str:
    """10 hex digits that change with every setting that can change a run's result.

    Args:
        config: plain, as `config.yaml` of a run holds it.
    """
    return hashlib.sha256(json.dumps(deciding(config), sort_keys=True, default=str).encode()).hexdigest()[:10]


def deciding(config: dict[str, Any]) -> dict[str, Any]:
    """Settings by dotted key that can change a run's result."""
    return {key: value for key, value in flat(config).items() if not key.startswith(WHERE_NOT_WHAT)}


def flat(node: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Settings by dotted key; a list counts as one setting."""
    found: dict[str, Any] = {}
    for key, value in node.items():
        found |= flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return found
