"""What callbacks show, keep, stop and prune, in trainings of balls and as conf/callbacks composes them."""

import csv
import logging
import time
from pathlib import Path

import lightning as L
import numpy as np
import pytest
import torch
from hydra.utils import instantiate
from lightning.pytorch.callbacks import EarlyStopping, LearningRateMonitor, ModelCheckpoint, ProgressBar
from lightning.pytorch.loggers import CSVLogger
from lightning.pytorch.loggers.logger import DummyLogger
from omegaconf import OmegaConf

from sdfhub.callbacks.checkpoints import StopOnSignal
from sdfhub.callbacks.media import show_mesh, show_picture
from sdfhub.callbacks.meshes_and_slices import MeshShapes, Slices
from sdfhub.callbacks.progress import ProgressLines, fitting_callbacks
from sdfhub.callbacks.pruning import OptunaPruning
from sdfhub.callbacks.training_record import TrainingRecord
from sdfhub.checkpoint_file import read_checkpoint
from sdfhub.composition import instantiate as from_config
from sdfhub.errors import SdfhubError
from tests.ball_training import Ball, BallModel, Balls, trained
from tests.test_config import composed

DEFAULT = ["mesh", "slices", "checkpoint", "snapshots", "stop_on_signal", "learning_rate", "progress_bar"]


class Kept(DummyLogger):
    """Keeps what it is shown."""

    def __init__(self):
        super().__init__()
        self.shown: list[tuple[str, int]] = []
        self.scalars: list[tuple[str, float, int]] = []

    def log_metrics(self, metrics, step=None):
        self.scalars += [(name, value, step) for name, value in metrics.items()]

    def steps(self, name: str) -> list[int]:
        return [step for shown, step in self.shown if shown == name]


@show_picture.register
def _(logger: Kept, name, image, step):
    assert image.dtype == np.uint8 and image.shape[2] == 3
    logger.shown.append((name, step))


@show_mesh.register
def _(logger: Kept, name, vertices, faces, up, step):
    assert len(vertices) and len(faces) and up == "z"
    logger.shown.append((name, step))


def small_meshes(times: int = 4) -> MeshShapes:
    return MeshShapes(times=times, shapes=2, resolution=12, points=50)


MESH, SLICE = "balls/0.4/reconstruction", "balls/0.4/slice_x0"


@pytest.mark.parametrize(
    ("settings", "steps"),
    [
        ({"max_epochs": 1, "max_steps": 3}, [1, 2, 3]),
        ({"max_epochs": 4}, [6, 12, 18, 24]),
        ({"max_epochs": 9, "max_steps": 16}, [4, 8, 12, 16]),
        ({"max_epochs": 4, "accumulate_grad_batches": 3}, [2, 4, 6, 8]),
    ],
)
def test_meshes_and_slices_appear_evenly_and_in_their_final_state(settings, steps):
    trained(small_meshes(), Slices(times=4), logger=(kept := Kept()), **settings)
    assert kept.steps(MESH) == kept.steps(SLICE) == kept.steps("balls/0.6/reconstruction") == steps
    assert kept.steps("balls/0.4/truth") == [0]
    assert [step for name, _, step in kept.scalars if name == "mesh/cd"] == steps


class StopAt(L.Callback):
    def __init__(self, step: int):
        self.step = step

    def on_train_batch_end(self, trainer, *_):
        trainer.should_stop = trainer.global_step == self.step


def test_stopped_continued_and_endless_trainings_show_their_final_state(tmp_path):
    trained(small_meshes(), StopAt(7), logger=(kept := Kept()), max_epochs=4)
    assert kept.steps(MESH) == [6, 7]
    trained(max_epochs=1).save_checkpoint(tmp_path / "last.ckpt")
    trained(small_meshes(4), logger=(kept := Kept()), max_epochs=4, ckpt_path=tmp_path / "last.ckpt")
    assert kept.steps(MESH) == [12, 18, 24]
    trained(small_meshes(), StopAt(3), logger=(kept := Kept()), max_epochs=-1)
    assert kept.steps(MESH) == [3]


def test_shapes_without_mesh_are_skipped_and_fields_without_surface_are_counted():
    shapes = [Ball(0.4, has_mesh=False), Ball(0.6)]
    trained(small_meshes(1), Slices(times=1), data=Balls(shapes), logger=(kept := Kept()))
    assert not kept.steps(MESH) and len(kept.steps("balls/0.6/reconstruction")) == len(kept.steps(SLICE)) == 1
    for start in (-5.0, torch.nan):
        trained(small_meshes(1), Slices(times=1), model=BallModel(start), logger=(kept := Kept()))
        assert not kept.steps(MESH) and kept.steps("balls/0.4/truth_and_reconstruction") == [12]
        assert [value for name, value, _ in kept.scalars if name == "mesh/failed"] == [2.0]
        assert not [name for name, *_ in kept.scalars if name == "mesh/cd"]
    trained(small_meshes(), data=Balls([Ball(0.4, has_mesh=False)]), logger=(kept := Kept()))
    assert not kept.shown


def test_chamfer_distances_are_in_the_unit_of_the_tables():
    meshes = MeshShapes(times=1, shapes=2, resolution=24, points=5000)
    trained(meshes, model=BallModel(0.1, rate=0.0), logger=(kept := Kept()), max_epochs=1)
    (cd,) = [value for name, value, _ in kept.scalars if name == "mesh/cd"]
    assert 18 < cd < 23, "both balls are 0.1 too large: 2 * 0.1^2, times 10^3, and little noise"


def test_the_record_counts_neither_pictures_nor_validation():
    class Slow(Slices):
        def show(self, trainer, module, shapes):
            time.sleep(0.2)

    class SlowValidation(BallModel):
        def validation_step(self, item, batch_idx):
            time.sleep(0.2)

    record = TrainingRecord()
    began = time.perf_counter()
    model = SlowValidation()
    trained(Slow(times=5), record, model=model)
    elapsed = time.perf_counter() - began
    summary = record.summary(model)
    assert summary["steps"] == 12 and summary["parameters"] == 1
    assert 0 < summary["seconds"] < elapsed - 1.5, "five times shown, four shapes validated"
    assert summary["loss"]["end"] > 0


def test_the_record_of_a_continued_training_goes_on(tmp_path):
    trained(first := TrainingRecord()).save_checkpoint(tmp_path / "last.ckpt")
    trained(second := TrainingRecord(), max_epochs=4, ckpt_path=tmp_path / "last.ckpt")
    assert second.summary(BallModel())["seconds"] > first.summary(BallModel())["seconds"] > 0


def test_early_stopping_and_the_best_checkpoint_follow_the_validation(tmp_path):
    """The radii grow through the true ones: at first the held-out ball gets better, then worse."""
    stop = EarlyStopping("train/sdf_error", patience=1)
    best = ModelCheckpoint(tmp_path, "best", monitor="train/sdf_error", enable_version_counter=False)
    logger = CSVLogger(tmp_path, "csv")
    trainer = trained(stop, best, model=BallModel(-0.12, rate=0.01), max_epochs=20, logger=logger)
    assert trainer.current_epoch == 3, "offsets -.06, 0, then .06, which is no better"
    assert read_checkpoint(tmp_path / "best.ckpt")["global_step"] == 12
    rows = list(csv.DictReader((tmp_path / "csv" / "version_0" / "metrics.csv").open()))
    assert len([row for row in rows if row["val/cd"]]) == 3


def test_a_checkpoint_of_the_best_val_cd_is_kept(tmp_path):
    best = ModelCheckpoint(tmp_path, "best", monitor="val/cd", enable_version_counter=False)
    trained(best, EarlyStopping("val/cd"), max_epochs=2)
    assert float(best.best_model_score) < 100 and read_checkpoint(tmp_path / "best.ckpt")


def test_averaged_weights_are_what_a_training_ends_with():
    node = composed("callbacks=ema")["callbacks"]["ema"]
    trained(instantiate(node, decay=0.5), model=(model := BallModel(0.0, rate=0.01)), max_epochs=1)
    average = 0.01  # after the first of six steps
    for step in range(2, 7):
        average = 0.5 * average + 0.5 * 0.01 * step
    assert model.decoder.offset.item() == pytest.approx(average)


def test_fast_dev_run_leaves_no_checkpoint(tmp_path):
    parts = composed("hydra.runtime.output_dir=" + str(tmp_path))["callbacks"]
    callbacks = [instantiate(parts[name]) for name in ("checkpoint", "snapshots", "stop_on_signal")]
    trained(*callbacks, small_meshes(), fast_dev_run=True)
    assert not list(tmp_path.rglob("*"))


def test_progress_in_a_file_is_ten_lines(caplog):
    caplog.set_level(logging.INFO)
    trained(ProgressLines(), max_epochs=5, enable_progress_bar=True)
    lines = [message for message in caplog.messages if "of 30, epoch" in message]
    assert len(lines) == 10 and lines[-1].startswith("step 30 of 30, epoch 5: loss ")


def names(*overrides: str) -> list[str]:
    return [name for name, node in composed(*overrides)["callbacks"].items() if node is not None]


def test_parts_compose_and_can_be_taken_away_replaced_and_added():
    assert names() == DEFAULT
    assert names("~callbacks.mesh") == names("callbacks.mesh=null") == DEFAULT[1:]
    assert names("callbacks=none") == ["stop_on_signal"]
    assert names("callbacks=early_stopping") == [*DEFAULT, "early_stopping"]
    assert names("callbacks=best") == [*DEFAULT, "best"]
    timer = [
        "+callbacks.timer._target_=lightning.pytorch.callbacks.Timer",
        "+callbacks.timer.duration=00:12:00:00",
    ]
    assert names(*timer)[-1] == "timer"
    assert composed("callbacks/progress_bar=rich")["callbacks"]["progress_bar"]["bar"] == "rich"
    assert composed("callbacks.mesh.times=3")["callbacks"]["mesh"]["times"] == 3


def test_the_default_parts_train_together(tmp_path):
    nodes = composed(
        "callbacks=early_stopping", f"hydra.runtime.output_dir={tmp_path}", "callbacks.mesh.resolution=12"
    )
    nodes["callbacks"]["mesh"]["times"] = nodes["callbacks"]["slices"]["times"] = 2
    nodes["callbacks"]["snapshots"]["every_n_epochs"] = 1
    callbacks = [instantiate(node) for node in nodes["callbacks"].values()]
    callbacks = fitting_callbacks(callbacks, loggers=False, progress_bar=True)
    assert not [c for c in callbacks if isinstance(c, LearningRateMonitor)]
    trained(*callbacks, enable_progress_bar=True, check_val_every_n_epoch=2)
    files = {path.name: read_checkpoint(path)["global_step"] for path in (tmp_path / "checkpoints").iterdir()}
    assert files == {"last.ckpt": 12, "step_0000006.ckpt": 6, "step_0000012.ckpt": 12}
    without = fitting_callbacks(callbacks, loggers=True, progress_bar=False)
    assert len(callbacks) - len(without) == 1 and not [c for c in without if isinstance(c, ProgressBar)]


@pytest.mark.parametrize("choice", ["fast_dev_run", "overfit", "limit", "profiler"])
def test_debug_choices_are_lightnings_settings(choice, tmp_path):
    config = composed(f"debug={choice}")
    own = (
        "fast_dev_run",
        "overfit_batches",
        "limit_train_batches",
        "limit_val_batches",
        "profiler",
        "max_epochs",
    )
    settings = {key: value for key, value in config["trainer"].items() if key in own}
    settings["max_epochs"] = 1
    assert trained(StopOnSignal(tmp_path), **settings).global_step in (1, 3, 6)


def test_settings_out_of_range_are_refused():
    node = composed()["callbacks"]["mesh"]
    for name, value in {"times": 0, "shapes": 0, "points": 0, "resolution": 1}.items():
        with pytest.raises(SdfhubError, match=f"{name}={value}"):
            from_config(OmegaConf.create({**node, name: value}), "callbacks.mesh")


def pruning(folder: Path, overrides: list[str], study: str = "search") -> OptunaPruning:
    optuna = pytest.importorskip("optuna")
    pruner = optuna.pruners.MedianPruner(n_startup_trials=2)
    return OptunaPruning(f"sqlite:///{folder}/study.db", study, overrides, pruner, "train/sdf_error")


def test_the_pruner_of_a_study_stops_a_training_that_is_worse_than_those_before(tmp_path):
    """As hydra's sweeper does it: trials are asked for, and their parameters are words on a command line."""
    optuna = pytest.importorskip("optuna")
    storage = f"sqlite:///{tmp_path}/study.db"
    study = optuna.create_study(study_name="search", storage=storage)
    steps = []
    for start in (-0.12, -0.1, 1.5, -0.11):
        trial = study.ask({"start": optuna.distributions.UniformDistribution(start, start)})
        other = study.ask({"start": optuna.distributions.UniformDistribution(9, 9)})  # runs beside it
        words = [f"start={trial.params['start']}", "seed=0"]
        trainer = trained(pruning(tmp_path, words), model=BallModel(trial.params["start"]), max_epochs=3)
        steps.append(trainer.global_step)
        study.tell(trial, float(trainer.callback_metrics["train/sdf_error"]))
        assert not optuna.load_study("search", storage).trials[other.number].intermediate_values
    assert steps == [18, 18, 6, 18]
    told = optuna.load_study("search", storage).get_trials(states=[optuna.trial.TrialState.COMPLETE])
    assert [sorted(trial.intermediate_values) for trial in told] == [
        [6, 12, 18],
        [6, 12, 18],
        [6],
        [6, 12, 18],
    ]


def test_a_training_that_belongs_to_no_trial_says_so(tmp_path):
    optuna = pytest.importorskip("optuna")
    with pytest.raises(SdfhubError, match="no study 'search'"):
        trained(pruning(tmp_path, []))
    optuna.create_study(study_name="search", storage=f"sqlite:///{tmp_path}/study.db")
    with pytest.raises(SdfhubError, match="no running trial"):
        trained(pruning(tmp_path, ["start=1.0"]))
