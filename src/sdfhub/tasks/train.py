"""Task `train`: samples in, a shape space out, and the table that judges it."""

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from lightning.pytorch import Callback, Trainer
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from omegaconf import DictConfig

from sdfhub.errors import SdfhubError
from sdfhub.tasks.app import run_task
from sdfhub.tasks.build import build, check, plain
from sdfhub.tasks.checkpoint import WholeFileIO, checkpointing
from sdfhub.tasks.evaluate import evaluate_model
from sdfhub.tasks.prepare import prepare_data
from sdfhub.tasks.run import begin_run, build_autodecoder


def train(config: dict[str, Any], run: Path) -> dict[str, Any]:
    """Trains what a plain config describes into the folder `run`; returns the evaluation's summary.

    Every part is built, and so checked, before the first shape is prepared.
    """
    config["seed"] = check(config["seed"], int, "seed")
    checkpoint = _existing_checkpoint(check(config["ckpt_path"], str | None, "ckpt_path"))
    evaluation = build(config["evaluate"], "evaluate")
    callbacks = {name: build(node, f"callbacks.{name}") for name, node in config["callbacks"].items()}
    every = {key: check(value, int | None, f"checkpoint.{key}") for key, value in config["checkpoint"].items()}
    checkpoints = checkpointing(run / "checkpoints", **every)
    make_trainer = build(config["trainer"], "trainer", within="lightning.pytorch")
    make_loader = build(config["data"]["loader"], "data.loader")
    build_autodecoder(config, rows=1)

    prepared = prepare_data(config["data"])
    loader = make_loader(shapes=prepared.train)
    model = build_autodecoder(config, loader.rows)
    begin_run(run, config, [shape.id for shape in prepared.train], [shape.id for shape in prepared.held_out])
    logger = TensorBoardLogger(run, name="", version="tensorboard", default_hp_metric=False)
    trainer = _trainer(make_trainer, run, logger, [*callbacks.values(), *checkpoints])
    print(f"run: {run}")
    trainer.fit(model, datamodule=loader, ckpt_path=checkpoint, weights_only=True)
    return evaluate_model(model, dict(enumerate(prepared.train)), prepared.held_out, evaluation, run)


def _trainer(make_trainer: Callable[..., Trainer], run: Path, logger, callbacks: list[Callback]) -> Trainer:
    """The trainer, or one line that says what it cannot do on this machine."""
    try:
        return make_trainer(default_root_dir=run, logger=logger, callbacks=callbacks, plugins=WholeFileIO())
    except (ValueError, TypeError, MisconfigurationException) as error:
        raise SdfhubError(f"trainer: {error}") from error


def _existing_checkpoint(path: str | None) -> str | None:
    if path is not None and not Path(path).is_file():
        raise SdfhubError(f"ckpt_path={path}: there is no such file; a run keeps checkpoints/last.ckpt")
    return path


def main() -> None:
    """Console entry: `python train.py activation=hosc encoding=fourier`."""
    warnings.filterwarnings("ignore", ".*does not have many workers.*")
    warnings.filterwarnings("ignore", ".*number of training batches.*smaller than the logging interval.*")

    def task(config: DictConfig) -> None:
        train(plain(config), Path(HydraConfig.get().runtime.output_dir))

    run_task(task, "config")
