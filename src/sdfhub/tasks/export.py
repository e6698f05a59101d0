"""Task `export`: a space as one file, as a function for other runtimes, or as meshes."""

import io
import warnings
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from omegaconf import DictConfig
from pydantic import Field
from torch.export import Dim
from tqdm import tqdm

from sdfhub.composition import plain
from sdfhub.described import check
from sdfhub.errors import SdfhubError
from sdfhub.geometry.mesh_file import FORMATS, write_mesh
from sdfhub.model.decoder import Decoder
from sdfhub.opening import beside, load, write_space
from sdfhub.whole_file import write_whole

# what a space is exported as in one file, and its name by default
FILES = {"safetensors": "model.safetensors", "onnx": "model.onnx", "torch_export": "model.pt2"}


def export(config: DictConfig) -> None:
    """The task: `config` as conf/export.yaml has it."""
    to, folder = str(config.to), beside(config.run, config.out, "export")
    if to == "meshes":
        export_meshes(config, folder)
        return
    path = folder / FILES[to] if to in FILES else Path(to)
    kind = {Path(file).suffix: kind for kind, file in FILES.items()}.get(path.suffix)
    if kind is None:
        raise SdfhubError(f"to={to}: choose {', '.join(FILES)}, meshes, or a file by one of their suffixes")
    space = load(config.run, device="cpu", trust=config.trust or ())
    if kind != "safetensors":
        write_whole(path, function_file(as_function(space.decoder), kind))
        print(f"function:  {path}: points [B, N, 3] and codes [B, L] to sdf [B, N]")
        path = path.with_suffix(".safetensors")  # the codes of the shapes
    write_space(space, path)
    print(f"space:     {path}: sdfhub.load({str(path)!r})")


def export_meshes(config: DictConfig, folder: Path) -> None:
    """Writes the meshes of all or of chosen shapes, each in its source's frame where that is known."""
    suffix = check(config.format, Literal[FORMATS], "format")
    shapes = Annotated[list[str | int], Field(min_length=1)] | str | int | None
    chosen = check(plain(config)["shapes"], shapes, "shapes")
    chosen = [chosen] if isinstance(chosen, str | int) else chosen
    space = load(config.run, trust=config.trust or ())
    ids = [space.ids[space.row(shape)] for shape in chosen or space.ids]
    empty = []
    meshes = tqdm(space.meshes(ids, config.resolution), total=len(ids), unit="shape", disable=None)
    for id, (vertices, faces) in zip(ids, meshes, strict=True):
        write_mesh(vertices, faces, folder / "meshes" / f"{id}.{suffix}")
        empty += [] if len(faces) else [id]
    frame = "their source's frame" if space.frames.keys() >= set(ids) else "the normalised frame"
    print(f"meshes:    {folder / 'meshes'}: {len(ids)} in {frame}; no surface: {', '.join(empty) or 'none'}")


def as_function(decoder: Decoder) -> torch.export.ExportedProgram:
    """A decoder as a function of points [B, N, 3] and codes [B, L] for any B and N >= 1."""
    example = (torch.zeros(2, 5, 3), torch.zeros(2, decoder.code_size))
    batch, points = Dim("B", min=1), Dim("N", min=1)
    shapes = {"points": {0: batch, 1: points}, "codes": {0: batch}}
    with warnings.catch_warnings(action="ignore"):
        return torch.export.export(decoder, example, dynamic_shapes=shapes)


def function_file(function: torch.export.ExportedProgram, kind: str) -> bytes:
    """A function as the content of a file."""
    content = io.BytesIO()
    with warnings.catch_warnings(action="ignore"):
        if kind == "torch_export":
            torch.export.save(function, content)
            return content.getvalue()
        try:
            import onnxscript  # noqa: F401 - PyTorch's exporter is written in it
        except ImportError as error:
            raise SdfhubError("to=onnx: needs more packages: pip install 'sdfhub[onnx]'") from error
        options: Any = {"input_names": ["points", "codes"], "output_names": ["sdf"]}
        axes = {"points": {0: "B", 1: "N"}, "codes": {0: "B"}}
        program = torch.onnx.export(function, dynamo=True, verbose=False, dynamic_shapes=axes, **options)
        assert program
        return program.model_proto.SerializeToString()
