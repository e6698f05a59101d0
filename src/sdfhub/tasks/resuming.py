"""What a checkpoint may be continued with: the settings and the shapes of its own training."""

from itertools import zip_longest
from pathlib import Path
from typing import Any

from sdfhub.errors import SdfhubError
from sdfhub.opening import read_run
from sdfhub.settings import WHERE_NOT_WHAT, flat

FREE_TO_CHANGE = (*WHERE_NOT_WHAT, "evaluate.", "data.source.root", "data.source.up", "trainer.max_")
"""Settings that change neither the model nor its data: a run may go on with others."""


def refuse_other_settings(checkpoint: Path, config: dict[str, Any]) -> None:
    """Refuses to continue a checkpoint under settings that its training did not have, and names them."""
    folder = checkpoint.parent.parent
    if not (folder / "config.yaml").is_file():
        return
    then, now = flat(read_run(folder)[0]), flat(config)
    keys = sorted(key for key in then | now if not key.startswith(FREE_TO_CHANGE))
    differing = [f"{k}={then.get(k)} (now {now.get(k)})" for k in keys if then.get(k) != now.get(k)]
    if differing:
        raise SdfhubError(f"ckpt_path={checkpoint}: was trained with {', '.join(differing)}; repeat that")


def refuse_other_shapes(checkpoint: Path, ids: list[str]) -> None:
    """Refuses to continue a checkpoint where data= now offers other shapes: a code is known by its row."""
    folder = checkpoint.parent.parent
    then = read_run(folder)[1]["train"] if (folder / "split.json").is_file() else ids
    for row, (before, now) in enumerate(zip_longest(then, ids, fillvalue="none")):
        if before != now:
            raise SdfhubError(
                f"ckpt_path={checkpoint}: the shapes that data= offers have changed: code {row} is that of "
                f"{before}, now it would be that of {now}; bring them back, or train anew"
            )
