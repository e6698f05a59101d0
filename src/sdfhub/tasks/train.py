"""Task `train`: samples in, a shape space out, and the table that judges it."""

import os
import re
import sys
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from hydra.utils import instantiate
from lightning.pytorch import Callback, Trainer
from lightning.pytorch.callbacks import Checkpoint
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from omegaconf import DictConfig
from pydantic import NonNegativeFloat
from torch import Tensor

from sdfhub.callbacks.checkpoints import WholeFileIO
from sdfhub.callbacks.progress import fitting_callbacks
from sdfhub.callbacks.training_record import TrainingRecord
from sdfhub.data.loading.batches import Loading
from sdfhub.data.loading.datamodule import SdfDataModule
from sdfhub.errors import SdfhubError
from sdfhub.model.autodecoder import AutoDecoder
from sdfhub.model.fast.computing import bfloat16_rate
from sdfhub.settings import flat
from sdfhub.shapes import Frame
from sdfhub.tasks.apart import CELL, must_run_apart, train_apart
from sdfhub.tasks.app import run_task
from sdfhub.tasks.build import Seed, build, check, plain
from sdfhub.tasks.cells import go_on, run_cell
from sdfhub.tasks.evaluate import Evaluation, build_evaluation, evaluate_model
from sdfhub.tasks.made_with import made_with
from sdfhub.tasks.prepare import Prepared, prepare_data
from sdfhub.tasks.processes import ending_together
from sdfhub.tasks.resuming import refuse_other_settings, refuse_other_shapes
from sdfhub.tasks.run import (
    begin_run,
    build_autodecoder,
    put_weights,
    read_weights,
    refuse_unwritable,
)
from sdfhub.tasks.search import objective
from sdfhub.tasks.sweep import MULTIRUNS, refuse_second_multirun

PRECISIONS = ("32-true", "32", "bf16-mixed", "bf16", "None")
"""Not all that Lightning offers: pieces of a batch are differentiated without a loss scale, and the loops
know float32 and bfloat16."""
STRATEGIES = ("auto", "ddp")
"""Beginnings of those that leave a model whole: checkpoints, and what is drawn and judged while it trains,
need every weight."""

SLOW = 0.8
"""Share of float32's rate below which bfloat16 does not pay; no processor known to us is near it."""

NO_CONCERN = (
    ".*does not have many workers.*",
    ".*number of training batches.*smaller than the logging interval.*",
    ".*The dirpath has changed.*",  # a continued run has a folder of its own
    ".*Checkpoint directory .* exists and is not empty.*",
    ".*ended before the epoch ended.*",  # our loader starts from the step that a checkpoint ends with
    ".*LeafSpec.*",  # Lightning's own use of a name that torch retires
)
"""Lightning's warnings that a user can do nothing about."""


@dataclass(frozen=True)
class Parts:
    """What a config describes, built and so checked before the first shape is prepared."""

    evaluation: Evaluation
    loading: Loading
    trainer: Trainer
    record: TrainingRecord
    resume_from: Path | None
    weights: dict[str, Tensor] | None


def train(config: dict[str, Any], run: Path) -> dict[str, Any]:
    """Trains what a plain config describes into the folder `run`.

    Returns:
        What `metrics.json` holds; empty in processes of a distributed run that are not the first.
    """
    for message in NO_CONCERN:  # here, not at the start of the program: a launcher's workers come here too
        warnings.filterwarnings("ignore", message)
    parts = build_parts(config, run)
    if must_run_apart(parts.trainer):
        return train_apart(run)
    if parts.loading.surface_per_shape:
        refuse_missing_normals(config["data"])
    refuse_unwritable(run)
    prepared = prepare_data(config["data"])
    if parts.resume_from:
        refuse_other_shapes(parts.resume_from, [shape.id for shape in prepared.train])
    loader = SdfDataModule(prepared.train, parts.loading)
    model = build_autodecoder(config, loader.rows, training_steps(config["trainer"], loader.steps_per_epoch))
    if parts.weights:
        put_weights(model, parts.weights, parts.resume_from)
    begin_run(
        run,
        config,
        train=[shape.id for shape in prepared.train],
        held_out=[shape.id for shape in prepared.held_out],
        frames={shape.id: Frame(shape.center, shape.scale) for shape in prepared.train},
        up=prepared.train[0].up,
    )
    print(f"run: {run}", flush=True)
    warn_of_slow_bfloat16(parts.trainer, config["decoder"]["width"])
    fit(model, loader, parts)
    if not parts.trainer.is_global_zero:
        return {}
    metrics = judge(model, prepared, parts, run)
    scores, step = final_scores(metrics), parts.trainer.global_step
    for logger in parts.trainer.loggers:
        if isinstance(logger, TensorBoardLogger):  # its table of runs
            logger.log_hyperparams(flat(config), scores, step)
        else:
            logger.log_hyperparams(flat(config))
            logger.log_metrics(scores, step)
    return metrics


def fit(model: AutoDecoder, loader: SdfDataModule, parts: Parts) -> None:
    """Trains, from the checkpoint that the parts name, if any.

    Raises:
        SdfhubError: the samples or a piece of a batch do not fit the GPU.
    """
    with ending_together(parts.trainer):
        try:
            parts.trainer.fit(model, datamodule=loader, ckpt_path=parts.resume_from, weights_only=True)
        except torch.OutOfMemoryError as error:
            raise SdfhubError(
                "the GPU's memory is full: lower computing.points_at_once (262144 by default); "
                "data.loader.resident=false leaves the samples on the disk"
            ) from error


def warn_of_slow_bfloat16(trainer: Trainer, width: int) -> None:
    """Tells of a CPU that multiplies float32 faster than the bfloat16 which it is asked for."""
    if trainer.precision != "bf16-mixed" or trainer.strategy.root_device.type != "cpu":
        return
    rate = bfloat16_rate(width)
    if rate < SLOW and trainer.is_global_zero:
        print(
            f"trainer.precision=bf16-mixed: this CPU multiplies bfloat16, {width} wide, {1 / rate:.1f} times "
            "slower than float32; 32-true is faster here, and more exact",
            file=sys.stderr,
        )


def judge(model: AutoDecoder, prepared: Prepared, parts: Parts, run: Path) -> dict[str, Any]:
    """What `metrics.json` holds: the training's cost and the scores of known and unseen shapes."""
    training = parts.record.summary(model) | {"made_with": made_with(parts.trainer)}
    if not parts.record.stepped:
        print(
            f"{parts.resume_from}: its training was finished (trainer.max_epochs would prolong it); judging"
        )
    known = dict(enumerate(prepared.train))
    model.to(parts.trainer.strategy.root_device)  # Lightning has put it back on the CPU
    codes = model.codes.table.detach()
    return evaluate_model(model.decoder, codes, known, prepared.held_out, parts.evaluation, run, training)


def training_steps(trainer: dict[str, Any], steps_per_epoch: int) -> int:
    """Optimiser steps of a whole training, from the trainer's `max_epochs` and `max_steps`.

    Raises:
        SdfhubError: `max_epochs` is no positive number; schedules need an end.
    """
    epochs = check(trainer["max_epochs"], int | None, "trainer.max_epochs")
    if epochs is None or epochs < 1:
        raise SdfhubError(f"trainer.max_epochs={epochs}: must be at least 1")
    limit = check(trainer.get("max_steps", -1), int, "trainer.max_steps")
    if limit == 0:
        raise SdfhubError("trainer.max_steps=0: must be at least 1, or -1 for none")
    return epochs * steps_per_epoch if limit < 0 else min(epochs * steps_per_epoch, limit)


def build_parts(config: dict[str, Any], run: Path) -> Parts:
    """The parts of a training run.

    Raises:
        SdfhubError: a setting that is unknown, missing, of the wrong type or out of range.
    """
    config["seed"] = check(config["seed"], Seed, "seed")
    resume_from = check(config["ckpt_path"], Path | None, "ckpt_path")
    callbacks = [instantiate(node) for node in config["callbacks"].values() if node]
    loggers = [instantiate(node) for node in config["logger"].values() if node]
    weights = read_weights(resume_from) if resume_from else None
    model = build_autodecoder(config, rows=len(weights["codes.table"]) if weights else 1)
    if weights:
        refuse_other_settings(resume_from, config)
        put_weights(model, weights, resume_from)  # before the first shape is prepared
    training_steps(config["trainer"], 1)
    record = TrainingRecord()
    bar = check(config["trainer"].get("enable_progress_bar", True), bool, "trainer.enable_progress_bar")
    callbacks = fitting_callbacks([*callbacks, record], bool(loggers), bar)
    trainer = build_trainer(config["trainer"], run, callbacks, loggers)
    model.computing.refuse_impossible(model.decoder.encoding, trainer.strategy.root_device)
    return Parts(
        evaluation=build_evaluation(config["evaluate"], config["loss"]),
        loading=build(config["data"]["loader"], "data.loader"),
        trainer=trainer,
        record=record,
        resume_from=resume_from,
        weights=weights,
    )


def refuse_missing_normals(data: dict[str, Any]) -> None:
    """Refuses a source without surface normals, before hours go into preparing it.

    Raises:
        SdfhubError: the source's shapes carry none.
    """
    source = build(data["source"], "data.source", within="sdfhub.data.sources")
    if not source.has_normals:
        raise SdfhubError(f"normals=on: the files of data={source.name} carry none; train with normals=off")


def final_scores(metrics: dict[str, Any]) -> dict[str, float]:
    """Mean and median CD and shapes without a surface by role, for TensorBoard's table of runs."""
    scores = {}
    for role in ("known", "held_out"):
        summary = metrics.get(role, {}).get("summary", {})
        values = {f"cd_{name}": summary.get("cd", {}).get(name) for name in ("mean", "median")}
        values["failed"] = summary.get("failed")
        scores |= {f"final/{role}_{name}": value for name, value in values.items() if value is not None}
    return scores


def build_trainer(node: dict[str, Any], run: Path, callbacks: list[Callback], loggers: list) -> Trainer:
    """The trainer, or one line that says what it cannot do on this machine, or would do wrongly.

    Raises:
        SdfhubError: names the setting.
    """
    if str(node.get("precision")) not in PRECISIONS:
        raise SdfhubError(f"trainer.precision={node['precision']!r}: use 32-true or bf16-mixed")
    if not str(node.get("strategy", "auto")).startswith(STRATEGIES):
        raise SdfhubError(
            f"trainer.strategy={node['strategy']}: use auto or ddp; every device has all weights"
        )
    check(node.get("gradient_clip_val"), NonNegativeFloat | None, "trainer.gradient_clip_val")
    ours = {"default_root_dir": run, "logger": loggers, "callbacks": callbacks, "plugins": WholeFileIO()}
    ours["enable_checkpointing"] = any(isinstance(callback, Checkpoint) for callback in callbacks)
    make = build(node, "trainer", within="lightning.pytorch", **ours)
    try:
        trainer = make()
    except (ValueError, TypeError, RuntimeError, ImportError, MisconfigurationException) as error:
        absent = isinstance(error, ImportError) or re.search("ccelerator|backend", str(error))
        hint = "; trainer.accelerator=auto trainer.devices=auto takes what this machine has" if absent else ""
        raise SdfhubError(f"trainer: {str(error).rstrip('.!')}{hint}") from error
    if trainer.accumulate_grad_batches != 1:  # large batches are worked on in pieces anyway
        raise SdfhubError(
            "trainer.accumulate_grad_batches: a step is one batch; raise data.loader.samples_per_shape"
        )
    limit = trainer.limit_train_batches  # 1 means one batch, 1.0 all of them
    if limit != 1.0 or isinstance(limit, int):  # schedules and draws count all steps of an epoch
        raise SdfhubError(
            "trainer.limit_train_batches: an epoch has data.loader.passes_per_epoch passes; set that"
        )
    return trainer


def main() -> None:
    """Console entry: `python train.py activation=hosc encoding=fourier`."""

    def task(config: DictConfig) -> float | None:
        hydra = HydraConfig.get()
        if hydra.mode == RunMode.MULTIRUN:
            return objective(run_cell(train, config, hydra))
        refuse_second_multirun(hydra)  # or it would be told to add -m, and then this
        for group in MULTIRUNS:
            if (name := hydra.runtime.choices.get(group)) and CELL not in os.environ:
                raise SdfhubError(f"{group}={name}: is a table of runs; add -m")
        go_on(train, plain(config), Path(hydra.runtime.output_dir))
        return None

    run_task(task, "config")
