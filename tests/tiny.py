"""Trainings of a second: the command line's words, and running them in this process."""

import json
import sys
import tempfile
from pathlib import Path

import torch
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf, open_dict

from sdfhub.checkpoint_file import read_checkpoint
from sdfhub.composition import configuration_folder, instantiate
from sdfhub.model.autodecoder import AutoDecoder
from sdfhub.multirun.names import register_resolvers
from sdfhub.tasks.command import main
from sdfhub.tasks.train import make_optimisation

ROOT = Path(__file__).parents[1]
TINY = [
    "scale=tiny",
    "data.shapes=2",
    "data.held_out=1",
    "data.preparation.samples=4000",
    "data.preparation.surface_points=1000",
    "data.loader.shapes_per_step=2",
    "data.loader.samples_per_shape=128",
    "data.loader.passes_per_epoch=5",
    "scale.normal_points=16",
    "decoder.width=32",
    "decoder.code_size=8",
    "evaluate.resolution=24",
    "evaluate.points=500",
    "evaluate.pictures=0",
    "fit.samples=500",
    "fit.steps=5",
    "trainer.max_epochs=2",
    "trainer.check_val_every_n_epoch=2",
    "trainer.log_every_n_steps=2",
    "callbacks.mesh.times=1",
    "callbacks.mesh.resolution=24",
    "callbacks.mesh.points=500",
    "callbacks.slices.times=1",
    "validation.resolution=24",
    "validation.points=500",
    "validation.fit.steps=3",
]

UNUSED = tempfile.TemporaryDirectory(prefix="sdfhub-")
"""Where a composed config that is not run as a task says that it writes."""

STORE = Path(UNUSED.name) / "store"
"""Prepared shapes that the trainings of a process share: to prepare them is most of a tiny training."""


def run_command(monkeypatch, *words: str, task: str = "train") -> int:
    """The exit status of a command in this process."""
    GlobalHydra.instance().clear()
    monkeypatch.setattr(sys, "argv", ["sdfhub", task, *words])
    try:
        main()
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0


def train_tiny(monkeypatch, folder: Path, *words: str) -> Path:
    """The run's folder of a training that ended well."""
    places = [f"hydra.run.dir={folder}", f"data.store={STORE}"]
    bare = any(word.startswith(("callbacks=", "debug=")) for word in words)
    tiny = [word for word in TINY if not (bare and word.startswith("callbacks."))]
    assert run_command(monkeypatch, *tiny, *places, *words) == 0
    return folder


def composed(*words: str, config_name: str = "config") -> DictConfig:
    """A composed config as a task sees it."""
    register_resolvers()
    GlobalHydra.instance().clear()
    with initialize_config_dir(str(configuration_folder()), version_base="1.3"):
        config = compose(config_name, list(words), return_hydra_config=True)
    with open_dict(config):
        if OmegaConf.is_missing(config.hydra.runtime, "output_dir"):
            config.hydra.runtime.output_dir = UNUSED.name
        HydraConfig.instance().set_config(config)
        del config["hydra"]
    return config


def scores(run: Path, role: str = "train") -> list[dict]:
    """The rows of `metrics.json` of a role."""
    return json.loads((run / "metrics.json").read_text())[role]["shapes"]


def build_autodecoder(config: DictConfig, rows: int):
    """The untrained model of a composed config."""
    torch.manual_seed(config.seed)
    names = ("decoder", "codes", "loss", "computing")
    parts = {name: instantiate(config[name], name) for name in names}
    optim = make_optimisation(config.optim)
    return AutoDecoder(**parts, optim=optim, shapes=rows, seed=config.seed)


def read_weights(path: Path) -> dict[str, torch.Tensor]:
    """The weights in a checkpoint."""
    return read_checkpoint(path)["state_dict"]
