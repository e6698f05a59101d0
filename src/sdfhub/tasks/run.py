"""A run's folder: what training leaves behind and every later task starts from. Plain data only.

config.yaml       the composed config, interpolations resolved
split.json        ids of the shapes by role; training ids in the order of the code table
checkpoints/      last.ckpt and its predecessors
metrics.json, metrics.csv, meshes/, contact_sheet.png, tensorboard/
"""

import json
import tempfile
from pathlib import Path
from typing import Any

import torch
import yaml

from sdfhub.errors import SdfhubError
from sdfhub.model.autodecoder import AutoDecoder
from sdfhub.model.codes import CodeTable
from sdfhub.tasks.build import build
from sdfhub.tasks.checkpoint import LAST, read_checkpoint
from sdfhub.whole_file import write_whole


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


def begin_run(run: Path, config: dict[str, Any], train: list[str], held_out: list[str]) -> None:
    """Writes down what a run is made of, before it starts."""
    write_whole(run / "config.yaml", yaml.safe_dump(config, sort_keys=False))
    write_whole(run / "split.json", json.dumps({"train": train, "held_out": held_out}, indent=1))


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
    except (ValueError, yaml.YAMLError) as error:
        raise SdfhubError(f"run={run}: config.yaml or split.json is broken: {error}") from error
    if not isinstance(config, dict) or set(split) != {"train", "held_out"}:
        raise SdfhubError(f"run={run}: config.yaml or split.json is not what training writes")
    return config, split


def build_autodecoder(config: dict[str, Any], rows: int, steps: int = 1) -> AutoDecoder:
    """The untrained model that a plain config describes, seeded.

    Args:
        config: what `config.yaml` of a run holds.
        rows: codes in the table.
        steps: optimiser steps of the whole training; only training needs it.
    """
    torch.manual_seed(config["seed"])
    return AutoDecoder(
        decoder=build(config["decoder"], "decoder", within="sdfhub.model"),
        codes=_codes(config, rows),
        loss=build(config["loss"], "loss", within="sdfhub.model"),
        optim=build(config["optim"], "optim", within="sdfhub.model"),
        steps=steps,
        computing=build(config["computing"], "computing", within="sdfhub.model")
        if "computing" in config
        else None,
        seed=config["seed"],
    )


def _codes(config: dict[str, Any], rows: int) -> CodeTable:
    make = build(config["codes"], "codes", within="sdfhub.model")
    try:
        return make(shapes=rows, size=config["decoder"]["code_size"])
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


def put_weights(model: AutoDecoder, weights: dict[str, torch.Tensor], path: Path) -> None:
    """Loads weights into a model.

    Raises:
        SdfhubError: they belong to a model of another shape; `path` says whose they are.
    """
    try:
        model.load_state_dict(weights)
    except (RuntimeError, TypeError, AttributeError) as error:
        detail = str(error).splitlines()[-1].strip()
        raise SdfhubError(f"{path}: holds another model than the one configured: {detail}") from error


def load_autodecoder(run: Path, config: dict[str, Any]) -> AutoDecoder:
    """The trained model of a run, on the CPU, in evaluation mode.

    Raises:
        SdfhubError: no readable checkpoint, or one of another model.
    """
    path = run / "checkpoints" / LAST
    weights = read_weights(path)
    model = build_autodecoder(config, rows=len(weights["codes.table"]))
    put_weights(model, weights, path)
    return model.eval()
