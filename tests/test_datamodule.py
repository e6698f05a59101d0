"""The LightningDataModule: alone, under a plain trainer, and stopped and resumed anywhere."""

import logging
import warnings
from pathlib import Path

import lightning as L
import pytest
import torch
import trimesh

from sdfhub.data.loading import Augmentation, Loading, SdfDataModule, ValidationShape
from sdfhub.data.preparation.settings import Preparation
from sdfhub.data.sources import FolderSource, ProceduralSource
from sdfhub.described import check_arguments
from sdfhub.errors import SdfhubError
from sdfhub.shapes import Batch
from tests.test_store import Balls

LOADER = Loading(shapes_per_step=2, samples_per_shape=16, surface_per_shape=4, passes_per_epoch=3, seed=5)
STEPS = 9
"""Of an epoch: 6 shapes, 2 at a time, 3 times."""


def balls(store: Path, loader: Loading = LOADER, count: int = 8, **settings) -> SdfDataModule:
    return SdfDataModule(Balls(count), store=str(store), workers=1, held_out=2, loader=loader, **settings)


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("store")


class Watching(L.LightningModule):
    """A model that notes what it sees."""

    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(1))
        self.seen: list[torch.Tensor] = []
        self.scored: list[ValidationShape] = []

    def training_step(self, batch: Batch, index: int):
        self.seen.append(batch.points)
        return self.weight.sum()

    def validation_step(self, item: ValidationShape, index: int):
        self.scored.append(item)

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), 0.1)


def trained(data: SdfDataModule, resume: Path | None = None, **settings) -> tuple[Watching, L.Trainer]:
    model, quiet = Watching(), dict.fromkeys(("logger", "enable_progress_bar", "enable_model_summary"), False)
    settings = {"max_epochs": 2, "enable_checkpointing": False, "num_sanity_val_steps": 0} | settings
    trainer = L.Trainer(accelerator="cpu", **quiet, **settings)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        trainer.fit(model, datamodule=data, ckpt_path=resume, weights_only=True)
    return model, trainer


def assert_steps(model: Watching, data: SdfDataModule, steps) -> None:
    steps = list(steps)
    assert len(model.seen) == len(steps)
    for points, step in zip(model.seen, steps, strict=True):
        assert torch.equal(points, data.batches[step].points), step


def test_without_a_trainer_epochs_end_and_go_on(store):
    data = balls(store)
    with pytest.raises(SdfhubError, match="call prepare_data"):
        _ = data.rows
    data.prepare_data()
    data.setup("fit")
    assert (data.rows, len(data.batches), len(data.held_out_shapes)) == (6, STEPS, 2)
    loader = data.train_dataloader()
    batches = [batch for _ in range(2) for batch in loader]
    assert len(loader) == STEPS and len(batches) == 2 * STEPS
    assert all(torch.equal(batch.points, data.batches[step].points) for step, batch in enumerate(batches))


def test_second_calls_are_free(store, monkeypatch):
    data = balls(store)
    data.prepare_data()
    monkeypatch.setattr(Balls, "shapes", lambda _: pytest.fail("listed again"))
    data.prepare_data()
    data.setup("fit")
    trained(data)


def test_held_out_shapes_are_scored_first(store):
    data = balls(store)
    model, _ = trained(data, max_epochs=1)
    assert [(item.role, item.row) for item in model.scored] == [
        ("held_out", None), ("held_out", None), ("train", 0), ("train", 1)
    ]  # fmt: skip
    assert [item.shape.id for item in model.scored[2:]] == [shape.id for shape in data.train_shapes[:2]]


@pytest.mark.parametrize(
    "settings, steps",
    [
        ({}, range(2 * STEPS)),
        ({"max_steps": 11, "max_epochs": -1}, range(11)),
        ({"limit_train_batches": 4}, range(8)),
        ({"limit_train_batches": 0.5, "max_epochs": 3}, range(12)),
        ({"accumulate_grad_batches": 3}, range(2 * STEPS)),
        ({"fast_dev_run": 2}, range(2)),
        ({"overfit_batches": 2}, [0, 1, 0, 1]),
    ],
)
@pytest.mark.parametrize("workers", [0, 2])
def test_a_trainer_may_end_epochs_as_it_likes(settings, steps, workers, store):
    if workers and not {"max_steps", "overfit_batches"} & settings.keys():
        pytest.skip("starts processes each epoch: two cases will do")
    data = balls(store, Loading(**vars(LOADER) | {"workers": workers}))
    assert_steps(trained(data, **settings)[0], data, steps)


class SavedAt(L.Callback):
    """Saves a checkpoint once so many steps are done."""

    def __init__(self, step: int, path: Path):
        self.step, self.path = step, path

    def on_train_batch_end(self, trainer, *_):
        if trainer.global_step == self.step and not self.path.exists():
            trainer.save_checkpoint(self.path)


@pytest.mark.parametrize(
    "accumulate, stop, done", [(1, 3, 3), (1, STEPS, STEPS), (1, 13, 13), (2, 3, 6), (2, 7, 13)]
)
def test_a_training_stopped_anywhere_goes_on_with_the_next_batch(accumulate, stop, done, store, tmp_path):
    path, plain = tmp_path / "stopped.ckpt", {"max_epochs": 4, "accumulate_grad_batches": accumulate}
    whole, _ = trained(balls(store), callbacks=SavedAt(stop, path), **plain)
    rest, _ = trained(balls(store), path, **plain)
    assert len(rest.seen) == 4 * STEPS - done
    assert all(torch.equal(*pair) for pair in zip(rest.seen, whole.seen[done:], strict=True))


def test_augmented_copies_have_rows_of_their_own(store):
    data = balls(store, Loading(shapes_per_step=2, augmentation=Augmentation(copies=2)))
    data.setup()
    assert data.rows == 18


def test_processes_share_a_batch_or_are_refused(store):
    data = balls(store)
    data.setup()
    whole = data.batches[4].rows
    data.batches.share(1, 2)
    assert torch.equal(data.batches[4].rows, whole[1::2])
    with pytest.raises(SdfhubError, match=r"data\.loader\.shapes_per_step=2 .* 3 processes"):
        data.batches.share(0, 3)


def test_normals_are_refused_before_a_shape_is_listed(tmp_path, monkeypatch):
    monkeypatch.setattr(Balls, "has_normals", False)
    monkeypatch.setattr(Balls, "shapes", lambda _: pytest.fail("listed"))
    with pytest.raises(SdfhubError, match="normals=on: the files of data=balls carry none"):
        balls(tmp_path).prepare_data()


@pytest.mark.parametrize("setting", ["workers", "shapes", "held_out", "split_seed", "validation_shapes"])
def test_numbers_out_of_range_are_refused_by_name(setting):
    with pytest.raises(SdfhubError, match=rf"data\.{setting}=-1: should be greater than"):
        check_arguments(SdfDataModule, {setting: -1}, "data")


def test_a_folder_of_eight_meshes_is_enough(tmp_path, caplog):
    caplog.set_level(logging.INFO)
    for index in range(8):
        mesh = trimesh.creation.icosphere(subdivisions=2, radius=1 + index)
        mesh.apply_scale([1, 1, 0.5]).export(tmp_path / f"{index}.ply")
    source = FolderSource(str(tmp_path))
    few = Preparation(samples=500, surface_points=50)
    data = SdfDataModule(source, str(tmp_path / ".store"), 1, shapes=20, preparation=few)
    data.prepare_data()
    assert (len(data.train_shapes), len(data.held_out_shapes)) == (7, 1)
    line = f"data: {source.name}: of 8 shapes 7 are trained on, 1 held out, 0 left out (data.shapes=20 and"
    assert line in caplog.text


def test_more_generated_shapes_than_there_are_is_a_mistake():
    with pytest.raises(SdfhubError, match="too few shapes"):
        SdfDataModule(ProceduralSource({"chairs": {}}, count=10), shapes=20).prepare_data()
