"""A run's settings as plain data: by dotted key, and as a digest that tells results apart."""

import hashlib
import json
from typing import Any

_KEYS = """
ckpt_path paths. debug print_config trust searched logger validation. data.store data.workers
data.validation data.loader.workers data.loader.resident callbacks.mesh callbacks.slices
callbacks.checkpoint callbacks.snapshots callbacks.progress callbacks.learning_rate
callbacks.stop_on_signal hparams_search. computing.points_at_once computing.compile computing.tinycudann
evaluate.workers evaluate.fit_together evaluate.pictures trainer.enable_ trainer.log_every_n_steps
trainer.accelerator trainer.devices trainer.strategy trainer.num_nodes trainer.logger trainer.callbacks
trainer.profiler trainer.num_sanity trainer.default_root_dir trainer.check_val trainer.val_check
trainer.limit_val
"""
WHERE_NOT_WHAT = tuple(_KEYS.split())
"""Beginnings of keys that say where a run happens and how it is watched: they change no result.

Other callbacks count: one that stops a training early decides its result.
"""

OF_THE_SEED = ("seed", "data.loader.seed")
"""Settings that follow from the seed."""


def settings_digest(config: dict[str, Any]) -> str:
    """10 hex digits that change with every setting of a plain config that can change a run's result."""
    return hashlib.sha256(json.dumps(deciding(config), sort_keys=True, default=str).encode()).hexdigest()[:10]


def deciding(config: dict[str, Any]) -> dict[str, Any]:
    """Settings by dotted key that can change a run's result."""
    return {key: value for key, value in flat(config).items() if not key.startswith(WHERE_NOT_WHAT)}


def flat(node: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Settings by dotted key; a list counts as one setting."""
    settings: dict[str, Any] = {}
    for key, value in node.items():
        settings |= flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return settings
