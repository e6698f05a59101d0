"""A trained shape space from disk: a run's folder, or one exported file.

What a file holds is data. Of its descriptions only classes of sdfhub and of trusted packages are built.
In `split.json` training ids are in the order of the code table.
"""

import json
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import yaml
from pydantic import TypeAdapter
from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor

from sdfhub.checkpoint_file import LAST, read_checkpoint
from sdfhub.described import built
from sdfhub.errors import SdfhubError
from sdfhub.model.saved import saved_decoder
from sdfhub.shapes import Frame, UpAxis
from sdfhub.space import Space
from sdfhub.whole_file import write_whole

if TYPE_CHECKING:
    from sdfhub.data.loading import SdfDataModule

Ids = Sequence[str]
FORMAT = "sdfhub space 2"  # of exported files; another number where their content means something else


def load(path: str | Path, device: str | torch.device | None = None, trust: str | Ids = ()) -> Space:
    """The trained shape space of a run's folder, or of a file that `sdfhub export` wrote.

    Args:
        path: `outputs/.../RUN` or `model.safetensors`.
        device: where it shall compute; None: on a GPU where there is one.
        trust: packages beside sdfhub whose classes the file may name, such as `"mypkg"`.

    Raises:
        SdfhubError: nothing usable is there, or not on this machine.
    """
    path = Path(path)
    if not path.exists():
        raise SdfhubError(f"{path}: there is no such run or file")
    where = _device(device)
    try:
        about, weights, codes = _of_run(path) if path.is_dir() else _of_file(path)
        ids = tuple(about["ids"])
        frames = about["frames"].items()
        return Space(
            decoder=saved_decoder(about["model"]["decoder"], weights, path, trust).to(where),
            codes=codes[: len(ids)].to(where),  # rows behind them are of augmented copies
            ids=ids,
            frames={id: Frame(np.array(four[:3], np.float64), float(four[3])) for id, four in frames},
            up=about["up"],
            model=about["model"],
            delta=float(about["model"]["loss"]["delta"]),
            config=about["config"],
            metrics=about["metrics"],
        )
    except (LookupError, TypeError, ValueError, AttributeError, OSError, RecursionError) as error:
        raise SdfhubError(f"{path}: not a shape space that this version reads: {error}") from error


def write_space(space: Space, path: Path) -> None:
    """Writes a space as one file, whole or not at all."""
    about: dict[str, Any] = {"model": space.model, "config": space.config, "ids": space.ids, "up": space.up}
    about |= {"frames": _plain_frames(space.frames), "metrics": space.metrics}
    tensors = {f"decoder.{name}": tensor for name, tensor in space.decoder.state_dict().items()}
    tensors = {name: tensor.cpu().contiguous() for name, tensor in (tensors | {"codes": space.codes}).items()}
    write_whole(path, save(tensors, metadata={"format": FORMAT, "about": json.dumps(about)}))


def _plain_frames(frames: Mapping[str, Frame]) -> dict[str, list[float]]:
    return {id: [*map(float, frame.center), float(frame.scale)] for id, frame in frames.items()}


def begin_run(
    run: Path, config: dict[str, Any], train: Ids, held_out: Ids, frames: Mapping[str, Frame], up: UpAxis
) -> None:
    """Writes down what a run is made of, before it starts; scores of what lay there before go."""
    (run / "metrics.json").unlink(missing_ok=True)  # else an interrupted run would pass for a finished one
    write_whole(run / "config.yaml", yaml.safe_dump(config, sort_keys=False))
    write_whole(run / "split.json", json.dumps({"train": [*train], "held_out": [*held_out]}, indent=1))
    write_whole(run / "frames.json", json.dumps({"up": up, "shapes": _plain_frames(frames)}))


def read_run(run: Path) -> tuple[dict[str, Any], dict[str, list[str]]]:
    """The config of a run's folder, and ids by role."""
    try:
        config = yaml.safe_load((run / "config.yaml").read_text(encoding="utf-8"))
        split = TypeAdapter(dict[str, list[str]]).validate_json((run / "split.json").read_bytes())
        split = {role: split[role] for role in ("train", "held_out")}
        return TypeAdapter(dict[str, Any]).validate_python(config), split
    except OSError as error:
        raise SdfhubError(f"run={run}: not a run's folder ({error.strerror}: {error.filename})") from error
    except (ValueError, KeyError, RecursionError, yaml.YAMLError) as error:
        what = "config.yaml or split.json is not what training writes"
        raise SdfhubError(f"run={run}: {what} ({str(error).splitlines()[0]})") from error


def data_of(config: dict[str, Any], trust: str | tuple[str, ...] = ()) -> "SdfDataModule":
    """The data that a run's config describes; a class of a package that is not trusted is refused."""
    from sdfhub.data.loading import SdfDataModule  # here: it needs Lightning, and a space does not

    data = built(with_environment(config.get("data")), "data", trust, within="sdfhub.data")
    if not isinstance(data, SdfDataModule):
        raise SdfhubError("the run's config.yaml describes no data")
    return data


def with_environment(node: Any) -> Any:
    """Plain data with `${oc.env:NAME}` replaced by this machine's environment, "" where it has none."""
    if isinstance(node, Mapping):
        return {name: with_environment(value) for name, value in node.items()}
    if not isinstance(node, str):
        return node
    return re.sub(r"\$\{oc\.env:(\w+)(?:,([^}]*))?\}", lambda m: os.environ.get(m[1], m[2] or ""), node)


def beside(run: str, out: str | None, name: str) -> Path:
    """The folder of a task's results: `out`, or one in the run's folder or beside its file."""
    return Path(out) if out else (Path(run) if Path(run).is_dir() else Path(run).parent) / name


def _of_run(run: Path) -> tuple[dict[str, Any], dict[str, Tensor], Tensor]:
    config, split = read_run(run)
    content = read_checkpoint(run / "checkpoints" / LAST)
    frames, metrics = run / "frames.json", run / "metrics.json"
    weights = dict(content["state_dict"])
    codes = weights.pop("codes.table")
    weights = {name.removeprefix("decoder."): weight for name, weight in weights.items()}
    about: dict[str, Any] = {"model": content["hyper_parameters"], "config": config, "ids": split["train"]}
    about["metrics"] = json.loads(metrics.read_bytes()) if metrics.exists() else None
    known = json.loads(frames.read_bytes()) if frames.exists() else {"up": "z", "shapes": {}}
    return about | {"up": known["up"], "frames": known["shapes"]}, weights, codes


def _of_file(path: Path) -> tuple[dict[str, Any], dict[str, Tensor], Tensor]:
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            if metadata.get("format") != FORMAT:
                format = repr(metadata.get("format", "unknown"))[:60]
                raise SdfhubError(f"{path}: its format is {format}, not {FORMAT!r}: export the run again")
            about = json.loads(metadata["about"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no mapping
        codes = tensors.pop("codes")
        weights = {name.removeprefix("decoder."): tensor for name, tensor in tensors.items()}
        names = ("model", "config", "ids", "frames", "up", "metrics")
        return {name: about[name] for name in names}, weights, codes
    except SdfhubError:
        raise
    except Exception as error:  # the reader knows a dozen kinds of damage
        raise SdfhubError(f"{path}: not a readable export; give a file that `sdfhub export` wrote") from error


def _device(device: str | torch.device | None) -> torch.device:
    try:
        wanted = torch.device(device or ("cuda" if torch.cuda.is_available() else "cpu"))
        torch.empty(1, device=wanted)
    except (RuntimeError, AssertionError) as error:
        raise SdfhubError(f"device={device}: not on this machine ({str(error).splitlines()[0]})") from error
    return wanted
