"""A run's folder: what training leaves behind and every later task starts from. Plain data only.

config.yaml       the composed config, interpolations resolved
split.json        ids of the shapes by role; training ids in the order of the code table
frames.json       which axis is up, and where the training shapes lie in their sources' frames
checkpoints/      last.ckpt and its predecessors
metrics.json, metrics.csv, meshes/, contact_sheet.png, tensorboard/
"""

import json
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import torch
import yaml
from hydra.utils import instantiate

from sdfhub.checkpoint_file import LAST, read_checkpoint
from sdfhub.errors import SdfhubError
from sdfhub.model.codes import CodeTable
from sdfhub.model.decoder import Decoder
from sdfhub.shapes import Frame
from sdfhub.tasks.build import build
from sdfhub.whole_file import write_whole

if TYPE_CHECKING:
    from sdfhub.model.autodecoder import AutoDecoder


def refuse_unwritable(folder: Path) -> None:
    """Makes a folder of results, before hours go into what should lie there.

    Raises:
        SdfhubError: nothing can be written there.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise SdfhubError(f"{folder}: cannot be written ({(error.strerror or '').lower()})") from error


def leave_no_empty_folder(folder: Path) -> None:
    """Removes the folder of results that never came."""
    if folder.is_dir() and not any(folder.iterdir()) and folder.resolve() != Path.cwd():
        folder.rmdir()


def begin_run(
    run: Path,
    config: dict[str, Any],
    train: Sequence[str],
    held_out: Sequence[str],
    frames: Mapping[str, Frame],
    up: Literal["y", "z"],
) -> None:
    """Writes down what a run is made of, before it starts; scores of what lay there before go."""
    (run / "metrics.json").unlink(missing_ok=True)  # else an interrupted run would pass for a finished one
    write_whole(run / "config.yaml", yaml.safe_dump(config, sort_keys=False))
    write_whole(run / "split.json", json.dumps({"train": [*train], "held_out": [*held_out]}, indent=1))
    write_whole(run / "frames.json", json.dumps({"up": up, "shapes": plain_frames(frames)}))


def plain_frames(frames: Mapping[str, Frame]) -> dict[str, list[float]]:
    """Frames as plain numbers: centre and scale, four of them."""
    return {id: [*map(float, frame.center), float(frame.scale)] for id, frame in frames.items()}


def read_run(run: Path) -> tuple[dict[str, Any], dict[str, list[str]]]:
    """The config and the split of a run's folder.

    Raises:
        SdfhubError: it is not a run's folder, or one of the files is broken.
    """
    try:
        config = yaml.safe_load((run / "config.yaml").read_text(encoding="utf-8"))
        split = json.loads((run / "split.json").read_text(encoding="utf-8"))
    except OSError as error:
        raise SdfhubError(f"run={run}: not a run's folder ({error.strerror}: {error.filename})") from error
    except (ValueError, RecursionError, yaml.YAMLError) as error:
        raise SdfhubError(f"run={run}: config.yaml or split.json is broken: {error}") from error
    are_ids = isinstance(split, dict) and all(
        isinstance(ids, list) and all(isinstance(id, str) for id in ids) for ids in split.values()
    )
    if not isinstance(config, dict) or not are_ids or set(split) != {"train", "held_out"}:
        raise SdfhubError(f"run={run}: config.yaml or split.json is not what training writes")
    return config, split


def build_decoder(node: Mapping[str, Any]) -> Decoder:
    """The untrained decoder that a plain node `decoder` of a config describes.

    Its classes are decoders, encodings, activations and conditioned layers of this package, whatever the
    node names.
    """
    given = {}
    if "conditioning" in node:  # the decoder's own way is not written down
        given["conditioning"] = build(
            node["conditioning"] or {}, "decoder.conditioning", within="sdfhub.model.conditioning"
        )
    for part, within in (("encoding", "sdfhub.model.encodings"), ("activation", "sdfhub.model.activations")):
        given[part] = build(node.get(part) or {}, f"decoder.{part}", within=within)
    rest = {key: value for key, value in node.items() if key not in given}
    return build(rest, "decoder", within="sdfhub.model.decoder", **given)


def build_autodecoder(config: dict[str, Any], rows: int, steps: int = 1) -> "AutoDecoder":
    """The untrained model that a plain config describes, seeded.

    Args:
        config: what `config.yaml` of a run holds.
        rows: codes in the table.
        steps: optimiser steps of the whole training; only training needs it.
    """
    from sdfhub.model.autodecoder import AutoDecoder  # here: a space is opened without Lightning

    torch.manual_seed(config["seed"])
    decoder = build_decoder(config["decoder"])
    return AutoDecoder(
        decoder=decoder,
        codes=_codes(config, rows, decoder.code_size),
        loss=instantiate(config["loss"]),
        optim=instantiate(config["optim"], _convert_="all"),
        steps=steps,
        computing=instantiate(config["computing"]) if "computing" in config else None,
        seed=config["seed"],
    )


def _codes(config: dict[str, Any], rows: int, size: int) -> CodeTable:
    make = build(config["codes"], "codes", within="sdfhub.model")
    try:
        return make(shapes=rows, size=size)
    except ValueError as error:
        raise SdfhubError(f"codes: {error}") from error


def read_weights(path: Path) -> dict[str, torch.Tensor]:
    """The `state_dict` of a checkpoint, on the CPU. Runs no code of it.

    Raises:
        SdfhubError: no such file, a damaged one, or not a checkpoint of an auto-decoder.
    """
    content = read_checkpoint(path)
    weights = content.get("state_dict") if isinstance(content, dict) else None
    # a view may claim more numbers than its file holds
    is_ours = isinstance(weights, dict) and all(
        isinstance(weight, torch.Tensor) and weight.is_contiguous() for weight in weights.values()
    )
    if not is_ours or getattr(weights.get("codes.table"), "ndim", 0) != 2:
        raise SdfhubError(f"{path}: not a checkpoint of an auto-decoder; a run keeps checkpoints/{LAST}")
    return weights


def put_weights(model: torch.nn.Module, weights: Mapping[str, torch.Tensor], path: Path) -> None:
    """Loads weights into an auto-decoder or a decoder.

    Raises:
        SdfhubError: they belong to a model of another shape; `path` says whose they are.
    """
    try:
        model.load_state_dict(weights)
    except (RuntimeError, TypeError, AttributeError) as error:
        detail = str(error).splitlines()[-1].strip()
        raise SdfhubError(f"{path}: holds another model than the one configured: {detail}") from error
