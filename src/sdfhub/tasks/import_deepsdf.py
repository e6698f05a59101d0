"""Task `import-deepsdf`: an experiment of DeepSDF's published code becomes a run.

Its decoder is ours in another order: layer 0 reads [code | point], a layer of `latent_in` reads
[hidden | code | point] and, with `xyz_in_all`, any other [hidden | point], where ours read
[hidden | encoding | code]; the output always passes through a tanh. Weight norm is multiplied out. Dropout of
hidden units and of codes acts in training alone: it does not bear on what an imported run computes.

Source: github.com/facebookresearch/DeepSDF: networks/deep_sdf_decoder.py, deep_sdf/workspace.py.
"""

import logging
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import torch
from omegaconf import DictConfig
from pydantic import BaseModel, Field
from torch import Tensor

from sdfhub.checkpoint_file import LAST, write_checkpoint
from sdfhub.composition import plain
from sdfhub.data.sources.deepsdf import DeepSdfSource, by_synset, frame_of, shape_id
from sdfhub.data.sources.source import names_listed
from sdfhub.errors import SdfhubError
from sdfhub.model.saved import PARTS, saved_decoder
from sdfhub.opening import begin_run, load
from sdfhub.report.results import read_json

log = logging.getLogger(__name__)

OWN_KEYS = ("folder", "epoch", "split", "out")  # of the task's config; no part of a training's


class NetworkSpecs(BaseModel, extra="forbid"):
    """`NetworkSpecs` of specs.json, the arguments of DeepSDF's decoder; its weights show the rest."""

    dims: list[int] = Field(min_length=1)
    dropout: list[int] | None = None
    dropout_prob: float = 0.0
    norm_layers: list[int] | None = None
    latent_in: list[int] = []
    weight_norm: bool = False
    xyz_in_all: bool | None = None
    use_tanh: Literal[False] = False  # another tanh before the last one
    latent_dropout: bool = False


class Specs(BaseModel):
    """What an import reads of specs.json; other keys say how it was trained and are kept as they are."""

    NetworkArch: Literal["deep_sdf_decoder"]
    NetworkSpecs: NetworkSpecs
    CodeLength: int = Field(ge=1)
    TrainSplit: str | None = None
    CodeBound: float | None = None
    ClampingDistance: float = 0.1
    CodeRegularizationLambda: float = 1e-4


def import_deepsdf(composed: DictConfig) -> None:
    """The task: a config as conf/import_deepsdf.yaml has it."""
    config = plain(composed)
    folder, epoch = Path(str(config["folder"])), config["epoch"]
    run = Path(str(config["out"] or Path(config["paths"]["output"], "deepsdf", folder.resolve().name)))
    if (run / "config.yaml").exists():
        raise SdfhubError(f"{run}: is there already; remove it, or choose another folder with out=")
    specs = read_json(Specs, folder / "specs.json", "an experiment of DeepSDF's")
    codes = read_codes(folder / "LatentCodes" / f"{epoch}.pth", specs.CodeLength)
    file = folder / "ModelParameters" / f"{epoch}.pth"
    node = config["decoder"] | decoder_settings(specs)
    weights = decoder_weights(_read(file, "model_state_dict"), node, file)
    saved_decoder(node, weights, file)  # or says what does not fit
    names = shape_names(folder, specs, config["split"], len(codes))
    source = config["data"]["source"]
    ids = [shape_id(name, by_synset(source["categories"])) for name in names]
    samples = Path(source["root"])
    samples = samples if samples.name == "SdfSamples" else samples / "SdfSamples"
    frames = {id: frame_of(samples / f"{name}.npz") for id, name in zip(ids, names, strict=True)}
    known = {id: frame for id, frame in frames.items() if frame}
    config = {key: value for key, value in config.items() if key not in OWN_KEYS} | {"decoder": node}
    config["codes"]["max_norm"] = specs.CodeBound
    config["loss"] |= {"delta": specs.ClampingDistance, "lambda_code": specs.CodeRegularizationLambda}
    begin_run(run, config, ids, [], known, DeepSdfSource.up)
    shutil.copyfile(folder / "specs.json", run / "specs.json")
    state = {f"decoder.{name}": weight for name, weight in weights.items()} | {"codes.table": codes}
    about = {name: config[name] for name in (*PARTS, "seed") if name in config} | {"shapes": len(codes)}
    write_checkpoint({"state_dict": state, "hyper_parameters": about}, run / "checkpoints" / LAST)
    log.info("run: %s: %d shapes, %d of them with their source's frame", run, len(load(run).ids), len(known))


def decoder_settings(specs: Specs) -> dict[str, Any]:
    """The settings of an experiment's decoder in our config; others are those of decoder=deepsdf."""
    network, depth = specs.NetworkSpecs, len(specs.NetworkSpecs.dims)
    return {
        "code_size": specs.CodeLength,
        "depth": depth,
        "width": network.dims[0],
        "inject_encoding": list(range(1, depth + 1)) if network.xyz_in_all else network.latent_in,
        "inject_code": network.latent_in,
        "weight_norm": False,
        "dropout": network.dropout_prob if {*range(depth)} <= {*(network.dropout or [])} else 0.0,
    }


def decoder_weights(parameters: Mapping[str, Tensor], node: dict[str, Any], path: Path) -> dict[str, Tensor]:
    """DeepSDF's parameters, from `path`, under the names and in the column order of our decoder, `node`."""
    left = {name.removeprefix("module."): tensor.clone() for name, tensor in parameters.items()}
    weights = {}
    try:
        for index in range(node["depth"] + 1):
            weights[f"layers.{index}.linear.bias"] = left.pop(f"lin{index}.bias")
            length = left.pop(f"lin{index}.weight_g", None)
            weight = left.pop(f"lin{index}.weight" if length is None else f"lin{index}.weight_v")
            if length is not None:
                direction = weight.double()
                weight = (direction * (length / direction.norm(dim=1, keepdim=True))).float()
            if index in (0, *node["inject_code"]):  # [hidden | code | point] to [hidden | point | code]
                hidden = weight.shape[1] - 3 - node["code_size"]
                weight = torch.cat([weight[:, :hidden], weight[:, -3:], weight[:, hidden:-3]], dim=1)
            weights[f"layers.{index}.linear.weight"] = weight
    except KeyError as error:
        raise SdfhubError(f"{path}: lacks {error}, which specs.json describes") from error
    if left:
        raise SdfhubError(f"{path}: has {min(left)}, which specs.json does not describe")
    return weights


def read_codes(path: Path, size: int) -> Tensor:
    """Codes [S, L] of the training shapes, from either form that DeepSDF has written them in."""
    codes = _read(path, "latent_codes")
    codes = codes.get("weight") if isinstance(codes, Mapping) else codes
    if not isinstance(codes, Tensor) or codes.dim() < 2 or codes.shape[-1] != size:
        raise SdfhubError(f"{path}: holds no codes of {size} numbers, as specs.json describes")
    return codes.reshape(-1, size).float().clone()


def _read(path: Path, key: str) -> Any:
    """One entry of a file of DeepSDF's. Runs no code of it."""
    try:
        return torch.load(path, map_location="cpu", weights_only=True)[key]
    except FileNotFoundError as error:
        kept = ", ".join(sorted(file.stem for file in path.parent.glob("*.pth"))) or "none"
        raise SdfhubError(f"{path}: there is no such checkpoint; epoch= can be: {kept}") from error
    except Exception as error:  # torch knows a dozen kinds of damage, and advises to read it unsafely
        raise SdfhubError(f"{path}: not a readable file of DeepSDF's with {key}") from error


def shape_names(folder: Path, specs: Specs, split: str | None, count: int) -> list[str]:
    """Names of the shapes in the order of their codes, from `split` or the experiment's file, or numbers."""
    above = [Path(), folder.resolve(), *folder.resolve().parents]  # what TrainSplit may be relative to
    places = [at / specs.TrainSplit for at in above if specs.TrainSplit]
    file = Path(str(split)) if split else next((place for place in places if place.is_file()), None)
    if file is None:
        log.warning("%s: %s is not here: shapes are numbered; or give split=", folder, specs.TrainSplit)
        return [f"shape/{row:05d}" for row in range(count)]
    names = list(names_listed(str(file), "train"))
    if len(names) != count:
        raise SdfhubError(f"{file}: lists {len(names)} shapes, but there are codes of {count}; give split=")
    return names
