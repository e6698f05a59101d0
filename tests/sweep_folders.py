"""Sweep folders with known scores, written as training writes them, without any training."""

import json
import re
from pathlib import Path

import numpy as np
import trimesh
import yaml

from sdfhub.report.results import PlannedCell, enter_cells

CHOICES = {
    "DeepSDF": {"experiment": "deepsdf", "activation": "relu", "encoding": "none", "decoder": "deepsdf"},
    "SIREN": {"experiment": "siren", "activation": "siren", "encoding": "none", "decoder": "small"},
    "FFT/SIREN": {
        "experiment": "fft_siren",
        "activation": "siren",
        "encoding": "fourier",
        "decoder": "small",
    },
    "FFT/HOSC": {"experiment": "fft_hosc", "activation": "hosc", "encoding": "fourier", "decoder": "small"},
}


def planned(method: str, normals: str = "on", seed: int = 0, sweep: str = "table_small", **settings):
    """A cell of a table of chairs."""
    common = {"sweeps": sweep, "data": "procedural", "category": "chairs", "scale": "cpu"}
    choices = common | CHOICES[method] | {"normals": normals}
    said = "".join(f"_{key}-{value}" for key, value in settings.items())
    folder = re.sub(r"[^A-Za-z0-9_-]", "-", f"{method}_{normals}_{seed}{said}")
    return PlannedCell(folder=folder, choices=choices, settings=settings, seed=seed)


def score(id: str, cd: float | None, floor: float = 0.05e-3, penalty: float = 0.4) -> dict:
    """A row of metrics.json; cd=None is a shape without a surface."""
    normals = None if cd is None else 0.9
    row = {"id": id, "cd": cd, "floor": floor, "cd_penalty": penalty, "failed": cd is None, "faces": 3}
    return row | {"normal_consistency": normals}


def write_cell(
    sweep: Path,
    cell: PlannedCell,
    train: list[float | None] = (),
    held_out: list[float | None] = (),
    seconds: float = 100.0,
    parameters: int = 1000,
    ids: str = "chairs/{:04d}",
    made_with: dict[str, str] | None = None,
    config: dict | None = None,
) -> Path:
    """Enters a cell into the plan and writes what a finished training of it leaves behind."""
    enter_cells(sweep, [cell])
    folder = sweep / cell.folder
    folder.mkdir(parents=True)
    roles = {"train": list(train), "held_out": list(held_out)}
    shapes = {
        role: [score(ids.format(k + 100 * (role == "held_out")), cd) for k, cd in enumerate(values)]
        for role, values in roles.items()
    }
    training = {"seconds": seconds, "steps": 50, "parameters": parameters}
    metrics = {"training": training | ({"made_with": made_with} if made_with else {})}
    metrics |= {role: {"summary": {}, "shapes": rows} for role, rows in shapes.items() if rows}
    (folder / "metrics.json").write_text(json.dumps(metrics))
    written = {
        "data": {"loader": {"shapes_per_step": 20, "samples_per_shape": 256}},
        "trainer": {"max_epochs": 90},
    }
    (folder / "config.yaml").write_text(yaml.safe_dump(written | (config or {})))
    split = {role: [row["id"] for row in rows] for role, rows in shapes.items()}
    (folder / "split.json").write_text(json.dumps(split))
    return folder


def write_mesh(folder: Path, id: str, role: str = "train", radius: float = 0.5) -> Path:
    """A ball where a cell's reconstruction lies."""
    path = folder / "meshes" / role / f"{id}.ply"
    path.parent.mkdir(parents=True, exist_ok=True)
    ball = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    trimesh.Trimesh(ball.vertices * np.array([1, 0.6, 1.2]), ball.faces).export(path)
    return path
