"""Task `import-deepsdf`: an experiment of DeepSDF's published code becomes a run.

Its decoder is ours in another order: layer 0 reads [code | point], a layer of `latent_in` reads
[hidden | code | point] and, with `xyz_in_all`, any other [hidden | point], where ours read
[hidden | encoding | code]; the output always passes through a tanh. Dropout of hidden units and of codes acts
in training alone, so it does not bear on what an imported run computes.

Source: github.com/facebookresearch/DeepSDF: networks/deep_sdf_decoder.py, deep_sdf/workspace.py.
"""

import json
import logging
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from torch import Tensor

from sdfhub.checkpoint_file import LAST, write_checkpoint
from sdfhub.composition import plain
from sdfhub.data.sources.deepsdf import DeepSdfSource, by_synset, frame_of, shape_id
from sdfhub.data.sources.split_file import names_listed
from sdfhub.described import check
from sdfhub.errors import SdfhubError
from sdfhub.model.saved import saved_decoder
from sdfhub.opening import begin_run, load
from sdfhub.shapes import Frame
from sdfhub.tasks.app import run_task

log = logging.getLogger(__name__)

OWN_KEYS = ("folder", "epoch", "split", "out")
"""Keys of the task's config that are no part of a training's."""


class NetworkSpecs(BaseModel):
    """`NetworkSpecs` of specs.json: the arguments of DeepSDF's decoder."""

    model_config = ConfigDict(extra="forbid")

    dims: list[int] = Field(min_length=1)
    dropout: list[int] | None = None
    dropout_prob: float = 0.0
    norm_layers: list[int] | None = None
    latent_in: list[int] = Field(default_factory=list)
    weight_norm: bool = False
    xyz_in_all: bool | None = None
    use_tanh: bool = False
    latent_dropout: bool = False


class Specs(BaseModel):
    """What an import reads of specs.json; other keys say how it was trained and are kept as they are."""

    NetworkArch: str
    NetworkSpecs: NetworkSpecs
    CodeLength: int = Field(ge=1)
    TrainSplit: str | None = None
    CodeBound: float | None = None
    ClampingDistance: float = 0.1
    CodeRegularizationLambda: float = 1e-4


def import_deepsdf(composed: DictConfig) -> Path:
    """The task: `config` as conf/import_deepsdf.yaml has it. Returns the run's folder."""
    config = plain(composed)
    folder, epoch = Path(check(config["folder"], str, "folder")), check(config["epoch"], str | int, "epoch")
    out, split = (check(config[key], str | None, key) for key in ("out", "split"))
    run = Path(out) if out else Path(config["paths"]["output"]) / "deepsdf" / folder.resolve().name
    if (run / "config.yaml").exists():
        raise SdfhubError(f"{run}: is there already; remove it, or choose another folder with out=")
    specs = read_specs(folder / "specs.json")
    codes = read_codes(folder / "LatentCodes" / f"{epoch}.pth", specs.CodeLength)
    parameters = folder / "ModelParameters" / f"{epoch}.pth"
    node = decoder_node(specs, folder / "specs.json")
    weights = decoder_weights(_read(parameters, "model_state_dict"), specs, node, parameters)
    saved_decoder(node, weights, parameters)  # or says what does not fit
    names = shape_names(folder, specs, split, len(codes))
    source = config["data"]["source"]
    ids = [shape_id(name, by_synset(source["categories"])) for name in names]
    frames = known_frames(Path(source["root"]), dict(zip(ids, names, strict=True)))
    config = {key: value for key, value in config.items() if key not in OWN_KEYS} | {"decoder": node}
    config["codes"] |= {"max_norm": specs.CodeBound}
    config["loss"] |= {"delta": specs.ClampingDistance, "lambda_code": specs.CodeRegularizationLambda}
    begin_run(run, config, ids, [], frames, DeepSdfSource.up)
    shutil.copyfile(folder / "specs.json", run / "specs.json")
    state = {f"decoder.{name}": weight for name, weight in weights.items()} | {"codes.table": codes}
    parameters = {"decoder": node, "shapes": len(codes), "seed": config["seed"]}
    parameters |= {name: config[name] for name in ("codes", "loss", "optim", "computing")}
    write_checkpoint({"state_dict": state, "hyper_parameters": parameters}, run / "checkpoints" / LAST)
    log.info(f"run: {run}: {len(load(run).ids)} shapes, {len(frames)} of them with their source's frame")
    return run


def read_specs(path: Path) -> Specs:
    """The settings of an experiment.

    Raises:
        SdfhubError: no experiment, or a decoder that ours cannot be; names the setting.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise SdfhubError(f"{path}: not an experiment of DeepSDF's ({error.strerror})") from error
    except (ValueError, RecursionError) as error:
        raise SdfhubError(f"{path}: not JSON: {error}") from error
    try:
        specs = Specs.model_validate(content)
    except ValidationError as error:
        wrong = error.errors()[0]
        key = ".".join(map(str, wrong["loc"]))
        raise SdfhubError(f"{path}: {key}: {wrong['msg'].lower()}") from error
    network, depth = specs.NetworkSpecs, len(specs.NetworkSpecs.dims)
    refusals = {
        "NetworkArch": specs.NetworkArch != "deep_sdf_decoder" and "only deep_sdf_decoder is known",
        "dims": len(set(network.dims)) > 1 and "layers of different widths cannot be represented",
        "use_tanh": network.use_tanh and "a tanh before the last tanh cannot be represented",
        "norm_layers": not network.weight_norm
        and bool({*(network.norm_layers or [])} & {*range(depth + 1)})
        and "LayerNorm (norm_layers without weight_norm) cannot be represented",
    }
    for key, refusal in refusals.items():
        if refusal:
            raise SdfhubError(f"{path}: {key}: {refusal}")
    return specs


def decoder_node(specs: Specs, path: Path) -> dict[str, Any]:
    """DeepSDF's decoder as a node of our config."""
    network, depth = specs.NetworkSpecs, len(specs.NetworkSpecs.dims)
    hidden = set(range(depth))
    if not set(network.latent_in) <= set(range(1, depth + 1)):
        raise SdfhubError(f"{path}: latent_in={network.latent_in}: names layers 1 to {depth}")
    return {
        "_target_": "sdfhub.model.decoder.Decoder",
        "encoding": {"_target_": "sdfhub.model.encodings.Identity"},
        "activation": {"_target_": "sdfhub.model.activations.Relu", "_partial_": True},
        "code_size": specs.CodeLength,
        "depth": depth,
        "width": network.dims[0],
        "inject_encoding": list(range(1, depth + 1)) if network.xyz_in_all else network.latent_in,
        "inject_code": network.latent_in,
        "shorten": True,
        "weight_norm": network.weight_norm and hidden <= set(network.norm_layers or []),
        "dropout": network.dropout_prob if hidden <= set(network.dropout or []) else 0.0,
        "tanh": True,
    }


def decoder_weights(
    parameters: Mapping[str, Tensor], specs: Specs, node: Mapping[str, Any], path: Path
) -> dict[str, Tensor]:
    """DeepSDF's parameters under the names and in the column order of our decoder.

    A layer's weight norm is kept where all hidden layers have one, else multiplied out.

    Args:
        parameters: of its decoder, by name.
        specs: what they belong to.
        node: our decoder's config.
        path: whose they are, for messages.
    """
    left = {name.removeprefix("module."): tensor for name, tensor in parameters.items()}
    found = {}
    try:
        for index in range(node["depth"] + 1):
            theirs, ours = f"lin{index}", f"layers.{index}.linear"
            reads_code = index == 0 or index in node["inject_code"]
            found[f"{ours}.bias"] = left.pop(f"{theirs}.bias")
            is_normed = f"{theirs}.weight_g" in left
            weight = left.pop(f"{theirs}.weight_v" if is_normed else f"{theirs}.weight")
            weight = _reordered(weight, specs.CodeLength) if reads_code else weight
            length = left.pop(f"{theirs}.weight_g") if is_normed else None
            if is_normed and node["weight_norm"] and index < node["depth"]:
                found[f"{ours}.parametrizations.weight.original0"] = length
                found[f"{ours}.parametrizations.weight.original1"] = weight
            else:
                precise = weight.double()
                whole = precise * (length / precise.norm(dim=1, keepdim=True)) if is_normed else precise
                found[f"{ours}.weight"] = whole.float()
    except KeyError as error:
        raise SdfhubError(f"{path}: lacks {error}, which specs.json describes") from error
    if left:
        raise SdfhubError(f"{path}: has {min(left)}, which specs.json does not describe")
    return {name: tensor.clone() for name, tensor in found.items()}


def _reordered(weight: Tensor, code_size: int) -> Tensor:
    """Columns [hidden | code | point] as [hidden | point | code]."""
    code = weight.shape[1] - 3 - code_size
    return torch.cat([weight[:, :code], weight[:, -3:], weight[:, code:-3]], dim=1)


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
    """Names of the shapes in the order of their codes: paths below its data's folder, or numbers.

    Args:
        folder: of the experiment; `TrainSplit` is relative to it or to a folder above, or to the present one.
        specs: names the split file.
        split: names another; must be there.
        count: of codes.

    Raises:
        SdfhubError: the file lists another number of shapes.
    """
    above = [Path(), *(parent for parent in (folder.resolve(), *folder.resolve().parents))]
    places = [Path(split)] if split else [at / specs.TrainSplit for at in above if specs.TrainSplit]
    file = next((place for place in places if place.is_file()), Path(split) if split else None)
    if file is None:
        log.warning(
            f"{folder}: TrainSplit {specs.TrainSplit} is not here: shapes are numbered; or give split="
        )
        return [f"shape/{row:05d}" for row in range(count)]
    names = list(names_listed(str(file), "train"))
    if len(names) != count:
        what = f"lists {len(names)} shapes, but there are codes of {count}"
        raise SdfhubError(f"{file}: {what}; give the file it was trained with by split=")
    return names


def known_frames(root: Path, name_of: Mapping[str, str]) -> dict[str, Frame]:
    """Frames of shapes, as far as DeepSDF's data lies at `root`."""
    samples = root if root.name == "SdfSamples" else root / "SdfSamples"
    found = {id: frame_of(samples / f"{name}.npz") for id, name in name_of.items()}
    return {id: frame for id, frame in found.items() if frame}


def main() -> None:
    """Console entry: `sdfhub import-deepsdf EXPERIMENT_DIR`."""
    run_task(lambda config: import_deepsdf(config) and None, "import_deepsdf", ["folder"])
