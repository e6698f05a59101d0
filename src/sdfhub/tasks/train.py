"""Task `train`: samples in, a shape space out, and the table that judges it."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from lightning.pytorch import Callback, Trainer
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from omegaconf import DictConfig
from torch import Tensor

from sdfhub.data.datamodule import SdfDataModule
from sdfhub.errors import SdfhubError
from sdfhub.tasks.app import run_task
from sdfhub.tasks.build import build, check, plain
from sdfhub.tasks.callbacks import TrainingRecord
from sdfhub.tasks.checkpoint import WholeFileIO, checkpointing
from sdfhub.tasks.evaluate import Evaluation, evaluate_model
from sdfhub.tasks.prepare import prepare_data
from sdfhub.tasks.run import begin_run, build_autodecoder, put_weights, read_weights


@dataclass(frozen=True)
class Parts:
    """What a config describes, built and so checked before the first shape is prepared."""

    evaluation: Evaluation
    make_loader: Callable[..., SdfDataModule]
    trainer: Trainer
    record: TrainingRecord
    resume_from: Path | None
    weights: dict[str, Tensor] | None


def train(config: dict[str, Any], run: Path) -> dict[str, Any]:
    """Trains what a plain config describes into the folder `run`.

    Returns:
        What `metrics.json` holds; empty in processes of a distributed run that are not the first.
    """
    parts = build_parts(config, run)
    prepared = prepare_data(config["data"])
    loader = parts.make_loader(shapes=prepared.train)
    model = build_autodecoder(config, loader.rows, training_steps(config["trainer"], loader.steps_per_epoch))
    if parts.weights:
        put_weights(model, parts.weights, parts.resume_from)
    begin_run(run, config, [shape.id for shape in prepared.train], [shape.id for shape in prepared.held_out])
    print(f"run: {run}", flush=True)
    trainer = parts.trainer
    trainer.fit(model, datamodule=loader, ckpt_path=parts.resume_from, weights_only=True)
    if trainer.interrupted:
        raise KeyboardInterrupt
    if not trainer.is_global_zero:
        return {}
    known = dict(enumerate(prepared.train))
    return evaluate_model(model, known, prepared.held_out, parts.evaluation, run, parts.record.summary(model))


def training_steps(trainer: dict[str, Any], steps_per_epoch: int) -> int:
    """Optimiser steps of a whole training, from the trainer's `max_epochs` and `max_steps`."""
    epochs = trainer["max_epochs"] * steps_per_epoch
    return epochs if trainer.get("max_steps", -1) < 0 else min(epochs, trainer["max_steps"])


def build_parts(config: dict[str, Any], run: Path) -> Parts:
    """The parts of a training run.

    Raises:
        SdfhubError: a setting that is unknown, missing, of the wrong type or out of range.
    """
    config["seed"] = check(config["seed"], int, "seed")
    resume_from = check(config["ckpt_path"], Path | None, "ckpt_path")
    every = {
        key: check(value, int | None, f"checkpoint.{key}") for key, value in config["checkpoint"].items()
    }
    callbacks = [build(node, f"callbacks.{name}") for name, node in config["callbacks"].items()]
    build_autodecoder(config, rows=1)
    record = TrainingRecord()
    callbacks += [record, *checkpointing(run / "checkpoints", **every)]
    return Parts(
        evaluation=build(config["evaluate"], "evaluate"),
        make_loader=build(config["data"]["loader"], "data.loader"),
        trainer=build_trainer(config["trainer"], run, callbacks),
        record=record,
        resume_from=resume_from,
        weights=read_weights(resume_from) if resume_from else None,
    )


def build_trainer(node: dict[str, Any], run: Path, callbacks: list[Callback]) -> Trainer:
    """The trainer, or one line that says what it cannot do on this machine."""
    make = build(node, "trainer", within="lightning.pytorch")
    logger = TensorBoardLogger(run, name="", version="tensorboard", default_hp_metric=False)
    try:
        return make(default_root_dir=run, logger=logger, callbacks=callbacks, plugins=WholeFileIO())
    except (ValueError, TypeError, MisconfigurationException) as error:
        raise SdfhubError(f"trainer: {error}; trainer=auto takes what this machine has") from error


def main() -> None:
    """Console entry: `python train.py activation=hosc encoding=fourier`."""
    warnings.filterwarnings("ignore", ".*does not have many workers.*")
    warnings.filterwarnings("ignore", ".*number of training batches.*smaller than the logging interval.*")
    warnings.filterwarnings("ignore", ".*LeafSpec.*")  # Lightning's own use of a name that torch retires

    def task(config: DictConfig) -> None:
        train(plain(config), Path(HydraConfig.get().runtime.output_dir))

    run_task(task, "config")
