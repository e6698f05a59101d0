"""The product as a user runs it: the script in processes of its own, meshes in, a Chamfer table out."""

import csv
import json
import os
import re
from pathlib import Path

import lightning as L
import numpy as np
import pytest
import torch
import yaml
from omegaconf import OmegaConf
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import sdfhub
from sdfhub.data.sources import ProceduralSource
from sdfhub.errors import SdfhubError
from sdfhub.geometry.metrics import chamfer
from sdfhub.geometry.surface import sample_surface
from sdfhub.opening import data_of
from sdfhub.procedural import generate
from sdfhub.shapes import RADIUS
from sdfhub.tasks.evaluate import choose_shapes, evaluate
from tests.commands import ROOT, Command
from tests.tiny import STORE, build_autodecoder, composed, read_weights, run_command

OPEN = ROOT / "data" / "open"
TINY = [
    "scale=tiny",
    "data.preparation.samples=4000",
    "data.preparation.surface_points=2000",
    "data.loader.samples_per_shape=256",
    "data.loader.passes_per_epoch=20",
    "decoder.width=48",
    "normals.points=32",
    "evaluate.resolution=48",
    "evaluate.points=2000",
    "evaluate.pictures=1",
    "fit.steps=20",
    "fit.samples=500",
    "validation.resolution=24",
    "validation.points=500",
    "validation.fit.samples=500",
]


def only_run(output_root: Path) -> Path:
    (config,) = output_root.glob("*/*/config.yaml")
    return config.parent


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> tuple[Path, str]:
    """One run of train.py on procedural chairs, and what it printed."""
    root = tmp_path_factory.mktemp("trained")
    command = Command(
        *TINY,
        "activation=hosc",
        "encoding=fourier",
        "data.shapes=3",
        "data.held_out=1",
        "trainer.max_epochs=6",
        "callbacks.mesh.times=5",
        "callbacks.mesh.resolution=24",
        "callbacks.mesh.points=500",
        "callbacks.slices.times=2",
        "trainer.check_val_every_n_epoch=3",
        "logger=many",
        f"data.store={STORE}",
        f"paths.output={root / 'outputs'}",
    )
    printed = command.output()
    return only_run(root / "outputs"), printed


def test_training_prints_the_table_and_where_everything_is(trained):
    folder, printed = trained
    for words in (
        "3 shapes to train on, 1 held out",
        "training shapes",
        "held-out shapes",
        "median",
    ):
        assert words in printed
    assert f"contact sheet: {folder}" in printed and (folder / "contact_sheet.png").is_file()


def test_metrics_files_hold_known_and_held_out_shapes_apart(trained):
    folder, _ = trained
    metrics = json.loads((folder / "metrics.json").read_text())
    assert [len(metrics[role]["shapes"]) for role in ("train", "held_out")] == [3, 1]
    assert metrics["train"]["summary"]["failed"] == 0, "every shape has a surface after training"
    for row in metrics["train"]["shapes"]:
        assert row["excess"] == pytest.approx(row["cd"] - row["floor"])
    rows = list(csv.DictReader((folder / "metrics.csv").open()))
    assert [row["role"] for row in rows] == ["train"] * 3 + ["held_out"]
    assert float(rows[0]["cd"]) == pytest.approx(metrics["train"]["shapes"][0]["cd"])


def test_split_is_written_down_and_disjoint(trained):
    split = json.loads((trained[0] / "split.json").read_text())
    assert len(split["train"]) == 3
    assert not set(split["train"]) & set(split["held_out"])


def test_meshes_are_written_in_their_sources_frame(trained):
    import trimesh

    folder, _ = trained
    shape = json.loads((folder / "split.json").read_text())["train"][0]
    category, index = shape.split("/")
    mesh = trimesh.load_mesh(folder / "meshes" / "train" / f"{shape}.ply")
    row = json.loads((folder / "metrics.json").read_text())["train"]["shapes"][0]
    sides = [
        sample_surface(*pair, 2000, 7)[0]
        for pair in ((mesh.vertices, mesh.faces), generate(category, int(index)))
    ]
    assert chamfer(*sides) == pytest.approx(row["cd_source"], rel=0.25)


def test_tensorboard_has_every_curve_picture_and_mesh(trained):
    events = EventAccumulator(str(trained[0] / "tensorboard"))
    events.Reload()
    wanted = [
        "loss/sdf",
        "loss/code",
        "loss/normal",
        "loss/total",
        "lr-Adam/decoder",
        "lr-Adam/codes",
        "codes/norm",
    ]
    wanted += ["beta/layer_0", "omega/layer_0", "speed/samples_per_second", "mesh/cd", "mesh/failed"]
    assert set(wanted) <= set(events.Tags()["scalars"])
    assert any("slice" in tag for tag in events.Tags()["images"])
    tensors = events.Tags()["tensors"]
    assert any("truth" in tag for tag in tensors)
    (mesh, *_) = [tag for tag in tensors if "reconstruction_VERTEX" in tag]
    assert [event.step for event in events.Tensors(mesh)][-1] == 120
    assert len(list((trained[0] / "csv" / "version_0").rglob("truth_and_reconstruction/*.png"))) == 2 * 5
    assert {"final/train_cd_median", "final/held_out_failed"} <= set(events.Tags()["scalars"])
    assert any("_hparams_" in tag for tag in events.summary_metadata)


def test_a_training_in_a_file_tells_ten_times_how_far_it_is(trained):
    lines = re.findall(r"step (\d+) of 120, epoch \d: loss 0\.\d+", trained[1])
    assert [int(step) for step in lines] == list(range(12, 121, 12))


def test_validation_is_logged(trained):
    (table,) = trained[0].glob("csv/*/metrics.csv")
    rows = list(csv.DictReader(table.open()))
    for key in ("val/cd", "val/sdf_error", "train/cd", "train/sdf_error"):
        values = [float(row[key]) for row in rows if row.get(key)]
        assert values and np.isfinite(values).all(), key


def test_a_finished_run_is_judged_again_at_another_resolution_and_on_other_shapes(
    trained, monkeypatch, capsys
):
    folder, _ = trained
    words = ["evaluate=fast", "evaluate.resolution=40", "evaluate.points=2000", "evaluate.pictures=1"]
    words += ["fit.steps=10", "fit.samples=500", "held_out=2", f"data.store={STORE}"]
    assert run_command(monkeypatch, str(folder), *words, task="evaluate") == 0
    assert "held-out shapes" in capsys.readouterr().out
    metrics = json.loads((folder / "evaluation" / "metrics.json").read_text())
    assert metrics["evaluation"]["resolution"] == 40
    assert len(metrics["held_out"]["shapes"]) == 2
    first = json.loads((folder / "metrics.json").read_text())
    assert metrics["train"]["shapes"][0]["id"] == first["train"]["shapes"][0]["id"]


def test_a_held_out_score_does_not_depend_on_the_shapes_beside_it(trained, tmp_path):
    folder, _ = trained
    few = ["evaluate=fast", "evaluate.resolution=32", "evaluate.points=1000", "evaluate.train=0"]
    few += ["fit.steps=15", "fit.samples=400", f"run={folder}"]
    scores = []
    for count in (1, 3):
        config = composed(*few, f"held_out={count}", f"out={tmp_path / str(count)}", config_name="evaluate")
        evaluate(config)
        shapes = json.loads((tmp_path / str(count) / "metrics.json").read_text())["held_out"]["shapes"]
        scores.append(
            {shape["id"]: shape["sdf_error"] if "sdf_error" in shape else shape["cd"] for shape in shapes}
        )
    (one,) = scores[0]
    assert scores[0][one] == pytest.approx(scores[1][one], rel=1e-3)


def test_trained_shapes_are_never_judged_as_unseen_ones_under_other_settings_of_their_source(trained):
    folder, _ = trained
    known = json.loads((folder / "split.json").read_text())["train"]
    source = ProceduralSource({"chairs": {}}, count=int(max(known)[-4:]) + 1)
    config = OmegaConf.create({"shapes": None, "held_out": None})
    roles = choose_shapes(source, {"train": [], "held_out": []}, set(known), config)
    assert not roles.train and not {shape.id for shape in roles.held_out} & set(known)
    assert len(roles.held_out) == source.count - len(known)
    with pytest.raises(SdfhubError, match="was trained on"):
        choose_shapes(
            source,
            {"train": [], "held_out": []},
            set(known),
            OmegaConf.create({"shapes": known, "held_out": None}),
        )


def test_a_trained_run_opens_as_a_space_with_the_frames_of_its_shapes(trained):
    folder, _ = trained
    space = sdfhub.load(folder, device="cpu")
    known = json.loads((folder / "split.json").read_text())["train"]
    assert space.ids == tuple(known) and set(space.frames) == set(known) and space.up == "z"
    assert space.metrics["train"]["summary"]["failed"] == 0
    for id, frame in space.frames.items():
        category, index = id.split("/")
        truth = generate(category, int(index))[0]
        normalised = frame.to_normalized(truth)
        assert np.allclose(normalised.min(0), -normalised.max(0)), "the bounding box is centred"
        assert np.isclose(np.linalg.norm(normalised, axis=1).max(), RADIUS)


def test_evaluate_without_a_run_says_so(tmp_path):
    with pytest.raises(SdfhubError, match="not a run's folder"):
        evaluate(composed("run=" + str(tmp_path), config_name="evaluate"))


def test_a_continued_run_ends_like_an_uninterrupted_one(tmp_path, monkeypatch, capsys):
    """Bit for bit on the CPU, with dropout, and with another number of loader processes."""
    common = [
        *TINY,
        "data.shapes=3",
        "data.held_out=0",
        "decoder.dropout=0.1",
        "data.loader.passes_per_epoch=4",
        "data.loader.shapes_per_step=2",
        f"data.store={STORE}",
        "callbacks=quiet",
        "evaluate.train=0",
        "optim=step",
        "trainer=cpu",
        "trainer.max_epochs=4",
    ]
    snapshots = ["callbacks.snapshots.every_n_epochs=1", f"paths.output={tmp_path / 'whole'}"]
    assert run_command(monkeypatch, *common, *snapshots) == 0
    whole = only_run(tmp_path / "whole") / "checkpoints"
    half = whole / "step_0000008.ckpt"
    rest = [f"ckpt_path={half}", "data.loader.workers=1", f"paths.output={tmp_path / 'rest'}"]
    Command(*common, *rest).output()
    rest = only_run(tmp_path / "rest") / "checkpoints"
    states = [torch.load(path / "last.ckpt", weights_only=True) for path in (whole, rest)]
    assert torch.load(half, weights_only=True)["global_step"] == 8
    assert states[0]["global_step"] == states[1]["global_step"]
    for name, value in states[0]["state_dict"].items():
        assert torch.equal(value, states[1]["state_dict"][name]), name
    others = ["decoder.dropout=0.2", "seed=1", "trainer.gradient_clip_val=1.0"]
    assert run_command(monkeypatch, *common, f"ckpt_path={half}", *others) == 2
    differing = "decoder.dropout=0.1 (now 0.2), seed=0 (now 1), trainer.gradient_clip_val=None"
    assert differing in capsys.readouterr().err


def curve(folder: Path, tag: str) -> list[float]:
    events = EventAccumulator(str(folder / "tensorboard"))
    events.Reload()
    return [event.value for event in events.Scalars(tag)]


def test_two_processes_train_like_one_with_the_same_batch(tmp_path, monkeypatch):
    """Gloo on the CPU; each process reads half of a batch's shapes, and codes are longer than max_norm."""
    common = [
        *TINY,
        "data.shapes=4",
        "data.held_out=0",
        "data.loader.passes_per_epoch=10",
        "codes.max_norm=0.9",
        f"data.store={STORE}",
        "callbacks=none",
        "evaluate.train=0",
        "trainer.max_epochs=1",
        "trainer.log_every_n_steps=1",
    ]
    assert run_command(monkeypatch, *common, "trainer=cpu", f"paths.output={tmp_path / 'one'}") == 0
    two = ["trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=2"]
    Command(*common, *two, f"paths.output={tmp_path / 'two'}").output()
    folders = [only_run(tmp_path / name) for name in ("one", "two")]
    for tag in ("loss/sdf", "loss/normal", "loss/code", "loss/total"):
        one, both = (curve(folder, tag) for folder in folders)
        assert len(one) == 10
        np.testing.assert_allclose(one, both, rtol=1e-4)
    states = [read_weights(folder / "checkpoints" / "last.ckpt") for folder in folders]
    for name, value in states[0].items():
        assert torch.allclose(value, states[1][name], atol=1e-4), name


COMBINATIONS = """
relu  none on, relu  fourier off, relu  gaussian on,  relu  hash off,
siren none on, siren fourier on,  siren gaussian off, siren hash on,
hosc  none off, hosc fourier on,  hosc  gaussian on,  hosc  hash off
"""
"""Every pair of choices of activation, encoding and normals."""


@pytest.fixture(scope="module")
def ball_batches():
    from tests.test_training import batches

    return batches(shapes=4, per_step=4, samples=96, surface=24)


def fit(module: L.LightningModule, batches, steps: int, callback: L.Callback, **settings) -> None:
    trainer = L.Trainer(
        accelerator="cpu",
        max_epochs=1,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        use_distributed_sampler=False,
        callbacks=[callback],
        **settings,
    )
    trainer.fit(module, torch.utils.data.DataLoader(batches, sampler=range(steps), batch_size=None))


@pytest.mark.parametrize("words", COMBINATIONS.split(","), ids=lambda words: "-".join(words.split()))
def test_combinations_lower_their_loss_from_their_defaults(words, ball_batches):
    names = ("activation", "encoding", "normals")
    choices = [f"{name}={word}" for name, word in zip(names, words.split(), strict=True)]
    module = build_autodecoder(composed(*choices), rows=4)
    losses = []

    class Keep(L.Callback):
        def on_train_batch_end(self, trainer, module, outputs, batch, batch_idx):
            losses.append(float(outputs["loss"]))

    fit(module, ball_batches, 60, Keep())
    assert all(torch.isfinite(torch.tensor(losses)))
    assert sum(losses[-10:]) < 0.9 * sum(losses[:10])


@pytest.mark.parametrize("precision", ["32-true", "bf16-mixed"])
@pytest.mark.parametrize(("algorithm", "order"), [("norm", 2), ("value", float("inf"))])
def test_gradients_are_clipped_under_either_precision(algorithm, order, precision, ball_batches):
    sizes, config = [], composed()

    class Keep(L.Callback):
        def on_train_batch_end(self, trainer, module, outputs, batch, batch_idx):
            gradients = [p.grad for p in module.parameters()]
            sizes.append(float(torch.nn.utils.get_total_norm(gradients, order)))

    settings = {"precision": precision, "gradient_clip_algorithm": algorithm}
    for limit in (None, -1.0, 1e-3):  # Lightning takes what is not positive for none
        torch.manual_seed(0)
        module = build_autodecoder(config, rows=4)
        fit(module, ball_batches, 3, Keep(), gradient_clip_val=limit, **settings)
    assert min(sizes[:3]) > 2e-3 and max(sizes[6:]) <= 1.001e-3
    assert sizes[3:6] == sizes[:3]


def test_a_full_memory_of_the_gpu_is_one_line(tmp_path, monkeypatch):
    from sdfhub.tasks import train as task

    def full(*arguments, **named):
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB.")

    monkeypatch.setattr(L.pytorch.Trainer, "fit", full)
    shapes = ["data.shapes=1", "data.held_out=0", f"data.store={STORE}", "callbacks=none"]
    with pytest.raises(SdfhubError, match=r"lower computing\.points_at_once"):
        task.train_into(composed(*TINY, *shapes), tmp_path / "run")


def test_a_diverging_run_stops_with_its_step_and_a_hint(tmp_path, monkeypatch, capsys):
    status = run_command(
        monkeypatch,
        *TINY,
        "data.shapes=2",
        "data.held_out=0",
        "optim.lr_decoder=1e30",
        "activation=relu",
        "callbacks=none",
        f"data.store={STORE}",
        f"paths.output={tmp_path / 'outputs'}",
    )
    printed = capsys.readouterr().err
    assert status == 2 and "Traceback" not in printed
    message = printed.strip().splitlines()[-1]
    assert "not finite at step" in message
    assert "lower optim.lr_decoder" in message


def test_one_bad_mesh_among_many_is_rejected_by_name_and_the_rest_goes_on(tmp_path, monkeypatch, capsys):
    import trimesh

    meshes = tmp_path / "meshes"
    meshes.mkdir()
    for index in range(3):
        vertices, faces = generate("chairs", index)
        trimesh.Trimesh(vertices, faces).export(meshes / f"chair_{index}.obj")
    (meshes / "broken.obj").write_text("v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    status = run_command(
        monkeypatch,
        "data=folder",
        f"data.source.root={meshes}",
        "data.shapes=4",
        "data.held_out=0",
        "data.preparation.samples=2000",
        f"data.store={STORE}",
        task="prepare",
    )
    printed = capsys.readouterr().out
    assert status == 0 and "3 shapes kept, 1 rejected" in printed and "broken" in printed


def test_deepsdfs_npz_files_train_without_normals_and_are_judged_by_distances(tmp_path, monkeypatch, capsys):
    rng = np.random.default_rng(0)
    for index in range(3):
        points = rng.uniform(-1, 1, (6000, 3))
        rows = np.column_stack([points, np.linalg.norm(points, axis=1) - 0.4 - 0.1 * index]).astype(
            np.float32
        )
        sides = {"pos": rows[rows[:, 3] >= 0], "neg": rows[rows[:, 3] < 0]}
        folder = tmp_path / "SdfSamples" / "ShapeNetV2" / "03001627"
        folder.mkdir(parents=True, exist_ok=True)
        np.savez(folder / f"ball{index}.npz", **sides)
        os.utime(folder / f"ball{index}.npz", (0, 0))  # a file's date seeds its samples
    common = [
        *(setting for setting in TINY if not setting.startswith("normals")),
        "data=deepsdf",
        f"data.source.root={tmp_path / 'SdfSamples'}",
        "data.shapes=2",
        "data.held_out=1",
        "trainer.check_val_every_n_epoch=5",
        "callbacks.mesh.resolution=24",
        "callbacks.mesh.times=1",
        "callbacks.slices.times=1",
        f"data.store={STORE}",
        f"paths.output={tmp_path / 'outputs'}",
    ]
    assert run_command(monkeypatch, *common) == 2
    assert "train with normals=off" in capsys.readouterr().err.strip().splitlines()[-1]
    assert run_command(monkeypatch, *common, "normals=off", "trainer.max_epochs=5") == 0
    assert "judged by signed distances" in capsys.readouterr().out
    metrics = json.loads((only_run(tmp_path / "outputs") / "metrics.json").read_text())
    assert metrics["train"]["summary"]["sign_accuracy"]["mean"] > 0.95
    assert len(metrics["held_out"]["shapes"]) == 1


@pytest.mark.skipif(not OPEN.is_dir(), reason="data/open is not there; `make data` fetches it")
def test_real_furniture_trains_to_a_table(tmp_path, monkeypatch):
    status = run_command(
        monkeypatch,
        *TINY,
        "data=open",
        "category=chairs",
        "data.shapes=3",
        "data.held_out=1",
        "trainer.max_epochs=6",
        "callbacks=none",
        f"data.store={STORE}",
        f"paths.output={tmp_path / 'outputs'}",
    )
    assert status == 0
    folder = only_run(tmp_path / "outputs")
    metrics = json.loads((folder / "metrics.json").read_text())
    assert len(metrics["train"]["shapes"]) >= 2
    config = yaml.safe_load((folder / "config.yaml").read_text())
    data = data_of(config)
    assert all(shape.credits["licence"] for shape in data.filled(data.split).values())
    assert config["data"]["source"]["root"] == str(OPEN), "a run is judged from anywhere"
