"""An experiment of DeepSDF's code becomes a run: the same distances, from a plain forward of that decoder."""

import copy
import json
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import DictConfig

import sdfhub
from sdfhub.errors import SdfhubError
from sdfhub.opening import read_run
from sdfhub.tasks.import_deepsdf import OWN_KEYS, import_deepsdf
from tests.tiny import composed, run_command

L, W = 5, 24
SPECS = {
    "Description": "balls",
    "DataSource": "data",
    "TrainSplit": "examples/splits/train.json",
    "NetworkArch": "deep_sdf_decoder",
    "NetworkSpecs": {
        "dims": [W] * 5,
        "dropout": [0, 1, 2, 3, 4],
        "dropout_prob": 0.2,
        "norm_layers": [0, 1, 2, 3, 4],
        "latent_in": [3],
        "xyz_in_all": False,
        "use_tanh": False,
        "latent_dropout": False,
        "weight_norm": True,
    },
    "CodeLength": L,
    "NumEpochs": 2001,
    "ClampingDistance": 0.2,
    "CodeBound": 1.0,
}
NETWORKS = {
    "as published": {},
    "points in every layer": {"xyz_in_all": True},
    "codes in two layers": {"latent_in": [2, 4]},
    "code in the last layer": {"latent_in": [5]},
    "no weight norm": {"weight_norm": False, "norm_layers": []},
    "weight norm on some layers": {"norm_layers": [1, 3]},
    "weight norm on all layers": {"norm_layers": [0, 1, 2, 3, 4, 5]},
    "no dropout, but of codes": {"dropout": None, "latent_dropout": True},
}
NAMES = {"ShapeNetV2": {"03001627": ["aaa", "b b"], "unlisted": ["ccc"]}}
IDS = ["chairs/aaa", "chairs/b_b", "ShapeNetV2_unlisted/ccc"]


def random_parameters(specs: dict) -> dict[str, torch.Tensor]:
    """Parameters as DeepSDF's decoder names them, of the sizes that its specification gives."""
    network = specs["NetworkSpecs"]
    sizes = [L + 3, *network["dims"], 1]
    found = {}
    for layer in range(len(sizes) - 1):
        outputs = sizes[layer + 1]
        if layer + 1 in network["latent_in"]:
            outputs -= L + 3
        elif network["xyz_in_all"] and layer < len(sizes) - 2:
            outputs -= 3
        weight = torch.randn(outputs, sizes[layer]) * (2 / sizes[layer]) ** 0.5
        found[f"lin{layer}.bias"] = torch.randn(outputs) * 0.1
        if network["weight_norm"] and layer in network["norm_layers"]:
            found[f"lin{layer}.weight_g"] = weight.norm(dim=1, keepdim=True) * (0.5 + torch.rand(outputs, 1))
            found[f"lin{layer}.weight_v"] = weight
        else:
            found[f"lin{layer}.weight"] = weight
    return found


def plain_forward(specs: dict, parameters: dict, code: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """Signed distances [N] at points [N, 3] as DeepSDF's decoder gives them, in double precision."""
    network = specs["NetworkSpecs"]
    given = torch.cat([code.expand(len(points), -1), points], dim=1).double()
    x, last = given, len(network["dims"])
    for layer in range(last + 1):
        if layer in network["latent_in"]:
            x = torch.cat([x, given], dim=1)
        elif layer and network["xyz_in_all"]:
            x = torch.cat([x, points.double()], dim=1)
        weight = parameters.get(f"lin{layer}.weight")
        if weight is None:
            direction = parameters[f"lin{layer}.weight_v"].double()
            weight = parameters[f"lin{layer}.weight_g"] * direction / direction.norm(dim=1, keepdim=True)
        x = x @ weight.double().T + parameters[f"lin{layer}.bias"].double()
        x = x.clamp(min=0) if layer < last else x
    return x.tanh()[:, 0]


def write_experiment(folder: Path, old: bool = False, **network) -> tuple[dict, dict, torch.Tensor]:
    """An experiment's folder as DeepSDF's trainer leaves it; its specs, parameters and codes."""
    torch.manual_seed(0)
    specs = SPECS | {"NetworkSpecs": SPECS["NetworkSpecs"] | network}
    experiment = folder / "examples" / "balls"
    for name in ("ModelParameters", "LatentCodes"):
        (experiment / name).mkdir(parents=True)
    (folder / "examples" / "splits").mkdir()
    (folder / "examples" / "splits" / "train.json").write_text(json.dumps(NAMES))
    (experiment / "specs.json").write_text(json.dumps(specs))
    parameters, codes = random_parameters(specs), torch.randn(3, L) * 0.5
    state = {f"module.{name}": tensor for name, tensor in parameters.items()}
    stored = codes[:, None] if old else {"weight": codes}
    for epoch in ("latest", "1000"):
        model = {"epoch": 1000, "model_state_dict": state}
        torch.save(model, experiment / "ModelParameters" / f"{epoch}.pth")
        torch.save({"epoch": 1000, "latent_codes": stored}, experiment / "LatentCodes" / f"{epoch}.pth")
    return specs, parameters, codes


@pytest.fixture(scope="module")
def config() -> DictConfig:
    """The task's config; the folder is to be filled in."""
    return composed("folder=here", config_name="import_deepsdf")


def imported(config: DictConfig, folder: Path, root: Path = Path("data"), **settings) -> sdfhub.Space:
    config, experiment = copy.deepcopy(config), folder / "examples" / "balls"
    config.data.source.root = str(root)
    settings = {"folder": str(experiment), "out": str(folder / "run")} | settings
    config.update(settings)
    import_deepsdf(config)
    return sdfhub.load(config.out, device="cpu")


@pytest.mark.parametrize("network", NETWORKS.values(), ids=NETWORKS)
def test_an_imported_run_gives_the_same_distances(network, config, tmp_path):
    specs, parameters, codes = write_experiment(tmp_path, **network)
    space = imported(config, tmp_path)
    points = torch.rand(200, 3) * 2 - 1
    assert space.ids == tuple(IDS)
    for row, id in enumerate(IDS):
        wanted = plain_forward(specs, parameters, codes[row], points)
        assert wanted.std() > 1e-2
        assert (space.sdf(points, id) - wanted).abs().max() < 1e-6


def test_the_run_carries_the_experiments_settings(config, tmp_path):
    write_experiment(tmp_path, old=True)
    space = imported(config, tmp_path, epoch=1000)
    config, split = read_run(tmp_path / "run")
    assert split == {"train": IDS, "held_out": []} and space.up == "y"
    assert config["codes"]["max_norm"] == 1.0 and config["loss"]["delta"] == 0.2
    assert config["decoder"]["dropout"] == 0.2
    assert not set(OWN_KEYS) & set(config)
    assert json.loads((tmp_path / "run" / "specs.json").read_text())["Description"] == "balls"


def test_frames_come_from_the_data_of_the_experiment(config, tmp_path):
    write_experiment(tmp_path)
    beside = tmp_path / "data" / "NormalizationParameters" / "ShapeNetV2" / "03001627"
    beside.mkdir(parents=True)
    np.savez(
        beside / "aaa.npz", offset=np.array([[-1.0, 0, 2]], np.float32), scale=np.array([4.0], np.float32)
    )
    space = imported(config, tmp_path, root=tmp_path / "data")
    assert list(space.frames) == ["chairs/aaa"]
    assert space.frames["chairs/aaa"].center.tolist() == [1, 0, -2] and space.frames["chairs/aaa"].scale == 4


def test_without_its_split_shapes_are_numbered_and_another_split_can_be_given(config, tmp_path, caplog):
    write_experiment(tmp_path)
    split = (tmp_path / "examples" / "splits" / "train.json").rename(tmp_path / "elsewhere.json")
    assert imported(config, tmp_path).ids == ("shape/00000", "shape/00001", "shape/00002")
    assert "give split=" in caplog.text
    again = imported(config, tmp_path, split=str(split), out=str(tmp_path / "again"))
    assert again.ids == tuple(IDS)


REFUSED = {
    "use_tanh": {"use_tanh": True},
    "geom_dimension": {"geom_dimension": 2},
}


def refusal(config: DictConfig, folder: Path, **settings) -> str:
    with pytest.raises(SdfhubError) as refused:
        imported(config, folder, **settings)
    assert not (folder / "run").exists()
    return str(refused.value)


@pytest.mark.parametrize("word", REFUSED)
def test_what_cannot_be_represented_is_refused_in_one_line(word, config, tmp_path):
    write_experiment(tmp_path)
    path = tmp_path / "examples" / "balls" / "specs.json"
    path.write_text(json.dumps(SPECS | {"NetworkSpecs": SPECS["NetworkSpecs"] | REFUSED[word]}))
    message = refusal(config, tmp_path)
    assert word in message and str(path) in message


def test_files_that_are_missing_or_broken_are_named(config, tmp_path):
    _, _, codes = write_experiment(tmp_path)
    experiment = tmp_path / "examples" / "balls"
    assert "epoch= can be: 1000, latest" in refusal(config, tmp_path, epoch=7)
    other = tmp_path / "other.json"
    other.write_text('["x"]')
    assert "lists 1 shapes, but there are codes of 3" in refusal(config, tmp_path, split=str(other))
    torch.save({"latent_codes": codes[:, :4]}, experiment / "LatentCodes" / "1000.pth")
    assert "no codes of 5 numbers" in refusal(config, tmp_path, epoch=1000)
    (experiment / "specs.json").write_text("{")
    assert "invalid json" in refusal(config, tmp_path)
    (experiment / "specs.json").unlink()
    assert "not an experiment of DeepSDF's" in refusal(config, tmp_path)


OTHERS = [
    ("lacks 'lin6.bias'", {"dims": [W] * 6, "latent_in": [3]}),
    ("has lin5", {"dims": [W] * 4}),
    ("another model", {"latent_in": [2]}),
    ("another model", {"dims": [W, W, W, W, W + 1]}),
    ("layers 1 to 5", {"latent_in": [0]}),
    ("layers 1 to 5", {"latent_in": [6]}),
]


@pytest.mark.parametrize(("message", "network"), OTHERS)
def test_parameters_of_another_decoder_are_refused(message, network, config, tmp_path):
    if network.get("dims", [W])[-1] != W:  # layers of different widths, which ours cannot have
        write_experiment(tmp_path, **network)
        assert message in refusal(config, tmp_path)
        return
    specs, _, _ = write_experiment(tmp_path)
    changed = specs | {"NetworkSpecs": specs["NetworkSpecs"] | network}
    (tmp_path / "examples" / "balls" / "specs.json").write_text(json.dumps(changed))
    assert message in refusal(config, tmp_path)


def test_layer_norms_are_refused(config, tmp_path):
    write_experiment(tmp_path, weight_norm=False)
    path = tmp_path / "examples/balls/ModelParameters/latest.pth"
    content = torch.load(path)
    content["model_state_dict"]["module.bn0.weight"] = torch.ones(W)
    torch.save(content, path)
    assert "has bn0.weight" in refusal(config, tmp_path)


def test_importing_runs_no_code_of_the_experiment(config, tmp_path):
    write_experiment(tmp_path)
    canary = tmp_path / "canary"

    class Stranger:
        def __reduce__(self):
            return os.system, (f"touch {canary}",)

    torch.save({"model_state_dict": Stranger()}, tmp_path / "examples/balls/ModelParameters/latest.pth")
    assert "not a readable file of DeepSDF's" in refusal(config, tmp_path)
    assert not canary.exists()


def test_the_command_takes_the_folder_as_its_first_word_and_writes_over_no_run(monkeypatch, tmp_path, capsys):
    write_experiment(tmp_path)
    words = [str(tmp_path / "examples" / "balls"), f"paths.output={tmp_path / 'outputs'}"]
    assert run_command(monkeypatch, *words, task="import-deepsdf") == 0
    assert "3 shapes, 0 of them with their source's frame" in capsys.readouterr().out
    assert sdfhub.load(tmp_path / "outputs" / "deepsdf" / "balls").ids == tuple(IDS)
    assert run_command(monkeypatch, *words, task="import-deepsdf") == 2
    assert "is there already" in capsys.readouterr().err
