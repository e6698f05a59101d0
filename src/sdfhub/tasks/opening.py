"""A trained shape space from disk: a run's folder or one exported file. Runs no code of either.

What a file says of itself (`About`) is plain data; of its config only the decoder is built, from classes of
this package, and only where the weights beside it have the sizes that it asks for.
"""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor

from sdfhub.errors import SdfhubError
from sdfhub.model.decoder import Decoder
from sdfhub.shapes import Frame
from sdfhub.space import Space
from sdfhub.tasks.build import check
from sdfhub.tasks.run import build_decoder, plain_frames, put_weights, read_run, read_weights
from sdfhub.whole_file import write_whole

FORMAT = "sdfhub space 1"
"""What an exported file says it is; another number where its content means something else."""

About = dict[str, Any]
"""Plain data of a space: config, ids, frames, up, metrics."""


def load(path: str | Path, device: str | torch.device | None = None) -> Space:
    """The trained shape space of a run's folder, or of a file that `sdfhub export` wrote.

    Args:
        path: `outputs/.../RUN` or `model.safetensors`.
        device: where it shall compute; None: on a GPU where there is one.

    Raises:
        SdfhubError: nothing usable is there, or not on this machine.
    """
    if not isinstance(path, str | Path):
        raise SdfhubError(f"load takes the path of a run or an exported file, got {path!r:.60}")
    path = Path(path)
    if not path.exists():
        raise SdfhubError(f"{path}: there is no such run or file")
    where = _device(device)
    try:
        about, weights, codes = _of_run(path) if path.is_dir() else _of_file(path)
        ids = tuple(about["ids"])
        frames = about["frames"].items()
        return Space(
            decoder=trained_decoder(about["config"]["decoder"], weights, path).to(where).eval(),
            codes=codes[: len(ids)].to(where),  # rows behind them are of augmented copies
            ids=ids,
            frames={id: Frame(np.array(four[:3], np.float64), float(four[3])) for id, four in frames},
            up=about["up"],
            config=about["config"],
            metrics=about["metrics"],
            delta=clamp(about["config"]),
        )
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        raise SdfhubError(f"{path}: not a shape space that this version reads: {error}") from error


def trained_decoder(node: Mapping[str, Any], weights: Mapping[str, Tensor], path: Path) -> Decoder:
    """The decoder of a config's node with its weights.

    Raises:
        SdfhubError: the weights are those of another decoder. A few bytes of config could ask for a decoder
            without bounds, so nothing is made before it is known that the weights are as many.
    """
    numbers = sum(weight.numel() for weight in weights.values())
    for key, value in _numbers(node, "decoder"):
        if value > max(numbers, 64):
            raise SdfhubError(f"{path}: {key}={value} is more than a decoder of {numbers} weights can have")
    try:
        with torch.device("meta"):
            expected = build_decoder(node).state_dict()
    except SdfhubError as error:
        raise SdfhubError(f"{path}: {error}") from error
    except (RuntimeError, TypeError, AttributeError, ArithmeticError) as error:
        raise SdfhubError(f"{path}: its config describes no decoder: {error}") from error
    for name in sorted(expected.keys() | weights.keys()):
        wanted, got = (list(part[name].shape) if name in part else "nothing" for part in (expected, weights))
        if wanted != got:
            what = f"{name}: {got}, not {wanted}"
            raise SdfhubError(f"{path}: holds another model than its config says: {what}")
    with torch.random.fork_rng(devices=[]):  # weights are drawn, though only to be replaced
        decoder = build_decoder(node)
    put_weights(decoder, weights, path)
    return decoder.requires_grad_(False)


def clamp(config: Mapping[str, Any]) -> float:
    """delta, within which a run learned distances, as its config says; codes are fitted under the same."""
    return check(config["loss"]["delta"], float, "loss.delta")


def beside(run: str, out: str | None, name: str) -> Path:
    """The folder of a task's results: `out`, or one in the run's folder or beside its file."""
    return Path(out) if out else (Path(run) if Path(run).is_dir() else Path(run).parent) / name


def write_space(space: Space, path: Path) -> None:
    """Writes a space as one file, whole or not at all."""
    about = {
        "config": space.config,
        "ids": space.ids,
        "frames": plain_frames(space.frames),
        "up": space.up,
        "metrics": space.metrics,
    }
    tensors = {f"decoder.{name}": tensor for name, tensor in space.decoder.state_dict().items()}
    tensors["codes"] = space.codes
    tensors = {name: tensor.cpu().contiguous() for name, tensor in tensors.items()}
    write_whole(path, save(tensors, metadata={"format": FORMAT, "about": json.dumps(about)}))


def _of_run(run: Path) -> tuple[About, dict[str, Tensor], Tensor]:
    config, split = read_run(run)
    weights = read_weights(run / "checkpoints" / "last.ckpt")
    codes = weights.pop("codes.table")
    weights = {name.removeprefix("decoder."): weight for name, weight in weights.items()}
    # runs of older versions have no frames
    frames = _json(run / "frames.json", {"up": "z", "shapes": {}})
    about = {"config": config, "ids": split["train"], "metrics": _json(run / "metrics.json", None)}
    return about | {"up": frames["up"], "frames": frames["shapes"]}, weights, codes


def _json(path: Path, otherwise: Any) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return otherwise
    except (ValueError, OSError, RecursionError) as error:
        raise SdfhubError(f"{path}: is broken: {error}") from error


def _of_file(path: Path) -> tuple[About, dict[str, Tensor], Tensor]:
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            if metadata.get("format") != FORMAT:
                found = repr(metadata.get("format", "unknown"))[:60]
                raise SdfhubError(f"{path}: its format is {found}, not {FORMAT!r}: export the run again")
            about = json.loads(metadata["about"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no mapping
        codes = tensors.pop("codes")
        weights = {name.removeprefix("decoder."): tensor for name, tensor in tensors.items()}
        return {key: about[key] for key in ("config", "ids", "frames", "up", "metrics")}, weights, codes
    except SdfhubError:
        raise
    except Exception as error:  # the reader knows a dozen kinds of damage
        raise SdfhubError(f"{path}: not a readable export; give a file that `sdfhub export` wrote") from error


def _numbers(node: Any, key: str) -> Iterator[tuple[str, float]]:
    """Every number of a plain node, with its dotted key."""
    if isinstance(node, Mapping):
        for name, value in node.items():
            yield from _numbers(value, f"{key}.{name}")
    elif isinstance(node, list):
        for value in node:
            yield from _numbers(value, key)
    elif isinstance(node, int | float) and not isinstance(node, bool):
        yield key, node


def _device(device: str | torch.device | None) -> torch.device:
    try:
        wanted = torch.device(device or ("cuda" if torch.cuda.is_available() else "cpu"))
        torch.empty(1, device=wanted)
    except (RuntimeError, AssertionError) as error:
        raise SdfhubError(f"device={device}: not on this machine ({str(error).splitlines()[0]})") from error
    return wanted
