"""Scalars, pictures and meshes in every logger, as it can."""

import csv
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hydra.utils import instantiate
from lightning.pytorch.callbacks import LearningRateMonitor
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from lightning.pytorch.loggers.logger import DummyLogger
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.util.tensor_util import make_ndarray

from sdfhub.callbacks.media import show_mesh, show_picture
from sdfhub.callbacks.meshes_and_slices import MeshShapes, Slices
from tests.ball_training import trained
from tests.test_config import CONF, composed

NAMES = [
    "balls/0.4/truth",
    "balls/0.4/reconstruction",
    "balls/0.4/truth_and_reconstruction",
    "balls/0.4/slice_x0",
]
POLE = trimesh.creation.cylinder(0.1, 1.0)
"""Stands along z."""


def of_group(choice: str, folder: Path, *overrides: str) -> list:
    """The loggers of a choice of the group `logger`."""
    words = [f"logger={choice}", f"hydra.runtime.output_dir={folder}", f"paths.output={folder}"]
    return [instantiate(node) for node in composed(*words, *overrides)["logger"].values()]


def shown(loggers: list) -> None:
    """A training of balls with everything that is shown."""
    parts = [MeshShapes(times=2, shapes=1, resolution=16, points=100), Slices(times=2, shapes=1)]
    trained(*parts, LearningRateMonitor("step"), logger=loggers)


def height_and_width(vertices: np.ndarray) -> tuple[float, float]:
    x, y, _ = np.ptp(vertices, axis=0)
    return y, x


def events(folder: Path) -> EventAccumulator:
    accumulator = EventAccumulator(str(folder), size_guidance={"tensors": 0})
    return accumulator.Reload()


def test_every_choice_of_the_group_has_named_parts():
    named = {
        path.stem: composed(f"logger={path.stem}")["logger"] for path in (CONF / "logger").glob("*.yaml")
    }
    assert {name: set(parts) for name, parts in named.items()} == {
        **{name: {name} for name in ("tensorboard", "csv", "wandb", "mlflow")},
        "many": {"tensorboard", "csv"},
        "none": set(),
    }


def test_many_loggers_are_all_served(tmp_path):
    shown(of_group("many", tmp_path))
    board = events(tmp_path / "tensorboard")
    assert {"val/cd", "train/sdf_error", "mesh/cd", "mesh/failed", "lr-SGD"} <= set(board.Tags()["scalars"])
    assert set(NAMES[2:]) <= set(board.Tags()["images"])
    assert all(any(tag.startswith(name) for tag in board.Tags()["tensors"]) for name in NAMES[:2])
    folder = tmp_path / "csv" / "version_0"
    rows = list(csv.DictReader((folder / "metrics.csv").open()))
    assert [row["step"] for row in rows if row["val/cd"]] == ["5", "11"]
    assert [row["step"] for row in rows if row["mesh/cd"]] == ["6", "12"]
    for name, last in zip(
        NAMES, ["00000000.glb", "00000012.glb", "00000012.png", "00000012.png"], strict=True
    ):
        assert max(path.name for path in (folder / name).iterdir()) == last


def test_csv_files_of_a_continued_training_stand_beside_those_of_the_first(tmp_path):
    for _ in range(2):
        trained(logger=of_group("csv", tmp_path), max_epochs=1)
    assert sorted(path.parent.name for path in tmp_path.glob("csv/*/metrics.csv")) == [
        "version_0",
        "version_1",
    ]


def test_no_logger_is_no_error(tmp_path):
    assert of_group("none", tmp_path) == []
    trained(MeshShapes(times=1, resolution=16, points=100), Slices(times=1), logger=False)


@pytest.mark.parametrize("up", ["y", "z"])
def test_meshes_stand_upright_where_y_is_up(up, tmp_path):
    vertices = np.array(POLE.vertices) if up == "z" else np.array(POLE.vertices)[:, [0, 2, 1]]
    show_mesh(board := TensorBoardLogger(tmp_path), "pole", vertices, POLE.faces, up, 3)
    show_mesh(table := CSVLogger(tmp_path), "pole", vertices, POLE.faces, up, 3)
    board.experiment.flush()
    (tag,) = [tag for tag in events(Path(board.log_dir)).Tags()["tensors"] if "VERTEX" in tag]
    drawn = make_ndarray(events(Path(board.log_dir)).Tensors(tag)[0].tensor_proto)[0]
    scene = trimesh.load_scene(Path(table.log_dir) / "pole" / "00000003.glb")
    for height, width in (height_and_width(drawn), height_and_width(scene.to_mesh().vertices)):
        assert height == pytest.approx(1.0, abs=1e-5) and width < 0.3


def test_tensorboard_gets_no_more_vertices_than_it_can_draw(tmp_path):
    ball = trimesh.creation.icosphere(7)
    assert len(ball.vertices) > 65_535
    show_mesh(logger := TensorBoardLogger(tmp_path), "ball", np.array(ball.vertices), ball.faces, "y", 0)
    logger.experiment.flush()
    board = events(Path(logger.log_dir))
    sizes = {
        tag: make_ndarray(board.Tensors(tag)[0].tensor_proto).shape[1] for tag in board.Tags()["tensors"]
    }
    assert 30_000 < min(sizes.values()) <= 60_100, sizes


def test_a_logger_of_ones_own_joins_with_a_line_and_others_show_nothing():
    class Mine(DummyLogger):
        seen = ()

    def keep(logger, name, image, step):
        logger.seen += ((name, image.shape, step),)

    picture = np.zeros((4, 5, 3), np.uint8)
    show_picture(mine := Mine(), "a", picture, 1)
    show_picture.register(Mine)(keep)
    show_picture(mine, "b", picture, 2)
    assert mine.seen == (("b", (4, 5, 3), 2),)


def test_wandb_offline_has_scalars_pictures_and_meshes(tmp_path, monkeypatch):
    wandb = pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_SILENT", "true")
    (logger,) = of_group("wandb", tmp_path, "logger.wandb.offline=true")
    shown([logger])
    history = dict(logger.experiment.summary)
    wandb.finish()
    assert {"val/cd", "mesh/cd", "lr-SGD"} <= set(history)
    (media,) = tmp_path.glob("wandb/offline-run-*/files/media")
    kinds = {path.suffix for path in media.rglob("*") if path.is_file()}
    assert {".png", ".glb"} <= kinds and len(list(media.rglob("*slice_x0*.png"))) == 2
    (mesh, *_) = media.rglob("*reconstruction*.glb")
    assert len(trimesh.load_scene(mesh).to_mesh().faces)


def test_mlflow_has_scalars_pictures_and_meshes(tmp_path, monkeypatch):
    pytest.importorskip("mlflow")
    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")  # a database takes ten seconds to make
    (logger,) = of_group("mlflow", tmp_path, f"logger.mlflow.tracking_uri=file:{tmp_path}/runs")
    shown([logger])
    assert {"val/cd", "mesh/cd", "lr-SGD"} <= set(logger.experiment.get_run(logger.run_id).data.metrics)
    files = {str(path.relative_to(tmp_path)).split("artifacts/", 1)[-1] for path in tmp_path.rglob("0*.*")}
    assert {f"{NAMES[1]}/00000012.glb", f"{NAMES[3]}/00000012.png"} <= files
    picture = next(tmp_path.rglob("00000012.png"))
    assert Image.open(picture).mode == "RGB"
