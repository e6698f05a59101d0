"""The folder that Hydra makes for a run before anybody knows whether there will be one."""

from contextlib import suppress
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig


class NoEmptyFolder(Callback):
    """Takes a run's folder away again where nothing was written into it, such as after a refusal.

    With it go the folders above it that were made for it, as far as they are empty; what was there before the
    run stays.
    """

    def __init__(self) -> None:
        self._made: list[Path] = []

    def on_run_start(self, config: DictConfig, **kwargs: Any) -> None:
        try:
            folder = Path(str(config.hydra.run.dir)).absolute()
            self._made = [path for path in (folder, *folder.parents) if not path.exists()]
        except Exception:  # a name that cannot be made out is the run's own failure, to be told there
            self._made = []

    def on_run_end(self, config: DictConfig, **kwargs: Any) -> None:
        with suppress(OSError):  # the first that is not empty, or that another process took away, ends it
            for path in self._made:
                path.rmdir()
