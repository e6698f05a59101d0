"""`train.py` in this process with a training that takes no time, and configs as its cells see them."""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml
from hydra import initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from sdfhub.errors import SdfhubError
from sdfhub.multirun.names import register_resolvers
from sdfhub.report.results import ROLES
from sdfhub.tasks import train as train_task
from sdfhub.tasks.command import main
from tests.sweep_folders import score

CONF = Path(__file__).parents[1] / "conf"


def of_multirun(function: Callable[[DictConfig], Any], *overrides: str, mode=RunMode.MULTIRUN) -> Any:
    """What `function` makes of the config, Hydra's part included, of `train.py -m OVERRIDES`."""
    register_resolvers()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        hydra = GlobalHydra.instance().hydra
        return function(hydra.compose_config("config", list(overrides), run_mode=mode))


class Training:
    """Writes scores that grow with the distance of the learning rate from 1e-3; fails or is stopped if asked.

    Attributes:
        configs: of each call, plain.
        fail, stop: whether a call with such a config, the n-th, fails or is interrupted.
    """

    def __init__(self) -> None:
        self.configs: list[dict[str, Any]] = []
        self.fail = self.stop = lambda config, n: False

    def __call__(self, config: Any, folder: Path) -> dict[str, Any]:
        config = OmegaConf.to_container(OmegaConf.create(config), resolve=True)
        self.configs.append(config)
        (folder / "config.yaml").write_text(yaml.safe_dump(config))
        (folder / "split.json").write_text(json.dumps({"train": ["a"], "held_out": []}))
        (folder / "metrics.json").unlink(missing_ok=True)
        if self.stop(config, len(self.configs)):
            raise KeyboardInterrupt
        if self.fail(config, len(self.configs)):
            raise SdfhubError("the loss is not finite at step 7")
        excess = 1e-3 + abs(config["optim"]["lr_decoder"] - 1e-3)
        metrics = {"training": {"seconds": 1.0, "steps": 5, "parameters": 9}}
        metrics[ROLES[0]] = {"summary": {}, "shapes": [score("a", excess)]}
        (folder / "metrics.json").write_text(json.dumps(metrics))
        return metrics

    def start(self, *words: str) -> int:
        """The exit status of `python train.py WORDS`."""
        sys.argv = ["sdfhub", "train", *words]
        try:
            main()
        except SystemExit as stop:
            return stop.code
        return 0


def stand_in(monkeypatch, folder: Path) -> Training:
    """Puts a stand-in in the place of training and goes into a folder."""
    training = Training()
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "argv", [])
    monkeypatch.setattr(train_task, "train_into", training)
    return training
