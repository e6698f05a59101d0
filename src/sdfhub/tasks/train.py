"""Task `train`: samples in, a shape space out, and the table that judges it."""

import logging
import warnings
from functools import partial
from itertools import zip_longest
from pathlib import Path
from typing import Annotated, Any, NamedTuple, cast

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from lightning.pytorch import Callback, Trainer
from lightning.pytorch.callbacks import Checkpoint
from lightning.pytorch.loggers import Logger, TensorBoardLogger
from lightning.pytorch.utilities.exceptions import SIGTERMException
from omegaconf import DictConfig, OmegaConf
from pydantic import Field

from sdfhub.callbacks.checkpoints import WholeFileIO
from sdfhub.callbacks.progress import fitting_callbacks
from sdfhub.callbacks.training_record import TrainingRecord, made_with
from sdfhub.checkpoint_file import LAST, read_checkpoint
from sdfhub.composition import instantiate, plain, with_absolute_paths
from sdfhub.data.loading import SdfDataModule
from sdfhub.described import check, located
from sdfhub.errors import SdfhubError
from sdfhub.evaluation.judging import Evaluation, evaluate_model
from sdfhub.model.autodecoder import AutoDecoder
from sdfhub.model.optimisers import Optimisation
from sdfhub.multirun.search import objective
from sdfhub.multirun.sweep import go_on, run_cell
from sdfhub.opening import begin_run, read_run
from sdfhub.report.results import ROLES
from sdfhub.settings import WHERE_NOT_WHAT, flat

log = logging.getLogger(__name__)

# half precision needs a loss scale; pieces of a batch are differentiated without one
WRONG_PRECISIONS = ("16", "16-true", "16-mixed", "transformer-engine", "transformer-engine-float16")
WHOLE_MODEL = ("auto", "ddp")  # strategies that leave every weight on every device, as meshing needs

# Lightning's warnings that a user can do nothing about
NO_CONCERN = (
    ".*does not have many workers.*",
    ".*number of training batches.*smaller than the logging interval.*",
    ".*The dirpath has changed.*",  # a continued run has a folder of its own
    ".*Checkpoint directory .* exists and is not empty.*",
    ".*ended before the epoch ended.*",  # the loader starts from the step that a checkpoint ends with
    ".*LeafSpec.*",  # Lightning's own use of a name that torch retires
)
# Lightning's loggers of what hardware there is not, advertisements, defaults of its own files
QUIET = ("pytorch.utilities.rank_zero", "fabric.utilities.rank_zero", "pytorch.trainer.connectors")
# settings that change neither the model nor its data: a run may go on with others
FREE_TO_CHANGE = (*WHERE_NOT_WHAT, "evaluate.", "data.source.root", "data.source.up", "trainer.max_")


class Parts(NamedTuple):
    """What a config describes, made once, before the first shape is prepared."""

    data: SdfDataModule
    model: partial[AutoDecoder]
    trainer: Trainer
    record: TrainingRecord
    evaluation: Evaluation


def train_into(config: DictConfig, folder: Path) -> dict[str, Any]:
    """Trains what a config describes into a folder; returns what `metrics.json` holds (first process)."""
    parts, written = make_parts(config, folder), plain(config)
    data, trainer = parts.data, parts.trainer
    refuse_processes_in_multirun(trainer)
    if config.ckpt_path:
        read_checkpoint(Path(config.ckpt_path))  # a damaged one is refused before shapes are prepared
        refuse_other_settings(Path(config.ckpt_path), written)
    data.prepare_data()
    data.setup("fit")
    ids, held_out = ([shape.id for shape in role] for role in (data.train_shapes, data.held_out_shapes))
    if config.ckpt_path:
        refuse_other_shapes(Path(config.ckpt_path), ids)
    model = parts.model(shapes=data.rows)
    frames = {shape.id: shape.frame for shape in data.train_shapes}
    kept = written | {"data": with_absolute_paths(written["data"])}
    begin_run(folder, kept, ids, held_out, frames, data.train_shapes[0].up)
    log.info("run: %s", folder)
    for logger in trainer.loggers:
        if not isinstance(logger, TensorBoardLogger):  # takes settings once, with the scores
            logger.log_hyperparams(flat(written))
    fit(model, parts, config.ckpt_path)
    if not trainer.is_global_zero or getattr(trainer, "fast_dev_run", False):  # which keeps nothing
        return {}
    if not (folder / "checkpoints" / LAST).exists():  # callbacks without one of checkpoints
        trainer.save_checkpoint(folder / "checkpoints" / LAST)
    training = parts.record.summary(model) | {"made_with": made_with(trainer)}
    model.to(trainer.strategy.root_device)  # Lightning has put it back on the CPU
    trained = model.decoder, model.codes.table.detach(), model.loss.delta
    shapes = dict(enumerate(data.train_shapes)), data.held_out_shapes
    metrics = evaluate_model(*trained, *shapes, parts.evaluation, folder, training)
    log_scores(trainer, written, metrics)
    return metrics


def make_parts(config: DictConfig, folder: Path) -> Parts:
    """The objects of a training; refuses a setting that is unknown, missing, of the wrong type or range."""
    for message in NO_CONCERN:  # here, not at the start of the program: a launcher's workers come here too
        warnings.filterwarnings("ignore", message)
    torch.manual_seed(check(config.seed, Annotated[int, Field(ge=0, lt=2**31)], "seed"))
    names = ["decoder", "codes", "loss", "computing", *(["validation"] if config.get("validation") else [])]
    model = {name: instantiate(config[name], name) for name in names}
    model["optim"] = make_optimisation(config.optim)
    record = TrainingRecord()
    callbacks = [*named_parts(config.get("callbacks"), "callbacks", Callback), record]
    loggers = named_parts(config.get("logger"), "logger", Logger)
    trainer = make_trainer(config.trainer, folder, callbacks, loggers)
    data, evaluation = instantiate(config.data, "data"), instantiate(config.evaluate, "evaluate")
    return Parts(data, partial(AutoDecoder, **model, seed=config.seed), trainer, record, evaluation)


def named_parts(config: DictConfig | None, group: str, kind: type) -> list[Any]:
    """The objects of a group of named parts, all of a Lightning `kind`; a part that is null is left out."""
    nodes = {f"{group}.{name!s}": node for name, node in (config or {}).items() if node is not None}
    parts = {key: instantiate(node, key) for key, node in nodes.items()}
    if wrong := [key for key, part in parts.items() if not isinstance(part, kind)]:
        raise SdfhubError(f"{wrong[0]}: is no Lightning {kind.__name__}; give it a _target_")
    return list(parts.values())


def make_optimisation(config: DictConfig) -> Optimisation:
    """What `optim` describes; its `_target_` may be an optimiser of PyTorch, in the place of Adam."""
    target: Any = located(config._target_, "optim")
    if issubclass(target, torch.optim.Optimizer):
        return Optimisation.of(hydra.utils.instantiate(config, _convert_="all", _partial_=True))
    return Optimisation.of(instantiate(config, "optim"))


def make_trainer(config: DictConfig, folder: Path, callbacks: list[Callback], loggers: list[Any]) -> Trainer:
    """Lightning's trainer; what the config says of callbacks, loggers and plugins goes before ours."""
    if str(config.get("precision")) in WRONG_PRECISIONS:
        raise SdfhubError(f"trainer.precision={config.precision}: needs a loss scale; use bf16-mixed")
    if not str(config.get("strategy", "auto")).startswith(WHOLE_MODEL):
        raise SdfhubError(f"trainer.strategy={config.strategy}: meshing needs a whole model; use ddp")
    has_logger = bool(loggers if config.get("logger") is None else config.logger)
    callbacks = fitting_callbacks(callbacks, has_logger, config.get("enable_progress_bar", True))
    ours: dict[str, Any] = {"default_root_dir": folder, "logger": loggers or False, "callbacks": callbacks}
    ours["enable_checkpointing"] = any(isinstance(callback, Checkpoint) for callback in callbacks)
    ours["plugins"] = [WholeFileIO()]
    for name in ("lightning", "lightning.pytorch", "lightning.fabric"):  # their text goes into train.log
        logging.getLogger(name).handlers.clear()
        logging.getLogger(name).propagate = True
    for name in QUIET:
        logging.getLogger(f"lightning.{name}").setLevel(logging.WARNING)
    given = {name: value for name, value in ours.items() if config.get(name) is None}
    return instantiate(config, "trainer", **given)


def fit(model: AutoDecoder, parts: Parts, checkpoint: str | None) -> None:
    """Trains, from a checkpoint if one is named; ends together with the other processes of the run."""
    try:
        parts.trainer.fit(model, datamodule=parts.data, ckpt_path=checkpoint, weights_only=True)
    except torch.OutOfMemoryError as error:
        hint = "lower computing.points_at_once, or leave samples on the disk: data.loader.resident=false"
        raise SdfhubError(f"the GPU's memory is full: {hint}") from error
    except SIGTERMException as stop:
        raise SystemExit(143) from stop  # Lightning's has status 0
    except RuntimeError as error:  # gloo raises it bare, NCCL a kind of it
        is_loss = isinstance(error, torch.distributed.DistError) or "onnection" in str(error)
        if parts.trainer.world_size == 1 or not is_loss:
            raise
        raise SdfhubError("another process of this run has died; continue its last checkpoint") from error


def refuse_processes_in_multirun(trainer: Trainer) -> None:
    """Refuses a cell whose trainer would start processes: each of them would walk the whole multirun."""
    cluster = getattr(trainer.strategy, "cluster_environment", None)
    starts = trainer.world_size > 1 and not (cluster and cluster.creates_processes_externally)
    if starts and HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN:
        raise SdfhubError("trainer.devices: a cell of a multirun has one device, or processes of SLURM")


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
    for row, (before, now) in enumerate(zip_longest(then, ids)):
        if before != now:
            what = f"code {row} is that of {before}, now it would be that of {now}"
            raise SdfhubError(f"ckpt_path={checkpoint}: the shapes that data= offers have changed: {what}")


def log_scores(trainer: Trainer, config: dict[str, Any], metrics: dict[str, Any]) -> None:
    """Mean and median CD x 10^3 and shapes without a surface by role, at the last step, as `final/...`."""
    scores: dict[str, float] = {}
    for role in filter(metrics.get, ROLES):
        summary = flat(metrics[role]["summary"])
        scores |= {f"final/{role}_failed": summary["failed"]} if "failed" in summary else {}
        values = {name: summary.get(f"cd.{name}") for name in ("mean", "median")}
        scores |= {f"final/{role}_cd_{k}": 1e3 * cd for k, cd in values.items() if cd is not None}
    for logger in trainer.loggers:
        if isinstance(logger, TensorBoardLogger):
            logger.log_hyperparams(flat(config), scores, step=trainer.global_step)
        else:
            logger.log_metrics(scores, trainer.global_step)
        logger.save()


def train(config: DictConfig) -> float | None:
    """One run, or one cell of a multirun, of a composed config with Hydra's own part set."""
    hydra = HydraConfig.get()
    if config.print_config:
        log.info(OmegaConf.to_yaml(config))
    if hydra.mode == RunMode.MULTIRUN:
        return objective(run_cell(train_into, config, cast(DictConfig, hydra)))
    go_on(train_into, config, Path(hydra.runtime.output_dir))
    return None
