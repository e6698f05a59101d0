"""Pictures and meshes for loggers, each of which shows them as it can.

A logger of your own joins with a line for either: `show_picture.register(MyLogger)(my_show_picture)`, where
`my_show_picture` takes the same arguments. Loggers without such a line show nothing.
"""

import tempfile
from functools import singledispatch
from pathlib import Path
from typing import Any

import fast_simplification
import numpy as np
import torch
from lightning.pytorch.loggers import CSVLogger, Logger, MLFlowLogger, TensorBoardLogger, WandbLogger
from PIL import Image

from sdfhub.geometry.mesh_file import write_row
from sdfhub.shapes import Mesh, UpAxis, turned_up

TENSORBOARD_VERTICES = 60_000
"""TensorBoard's mesh plugin indexes vertices with 16 bits and draws garbage beyond 65,535."""


@singledispatch
def show_picture(logger: Logger, name: str, image: np.ndarray, step: int) -> None:
    """Shows a picture [H, W, 3] uint8 under a name, the same at every step, whose parts "/" separates."""


@singledispatch
def show_mesh(logger: Logger, name: str, vertices: Any, faces: Any, up: UpAxis, step: int) -> None:
    """Shows a mesh upright: vertices [V, 3], normalised frame, faces [F, 3], F > 0, its upward axis."""


@show_picture.register
def _(logger: TensorBoardLogger, name, image, step):
    logger.experiment.add_image(name, image, step, dataformats="HWC")


@show_mesh.register
def _(logger: TensorBoardLogger, name, vertices, faces, up, step):
    if len(vertices) > TENSORBOARD_VERTICES:
        share = 1 - TENSORBOARD_VERTICES / len(vertices)
        vertices, faces = fast_simplification.simplify(vertices.astype(np.float32), faces, share)
    arrays = torch.from_numpy(turned_up(vertices, up, "y")).float(), torch.from_numpy(faces).int()
    logger.experiment.add_mesh(name, arrays[0][None], None, arrays[1][None], global_step=step)


@show_picture.register
def _(logger: CSVLogger, name, image, step):
    path = Path(logger.log_dir) / name / f"{step:08d}.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image).save(path)


@show_picture.register
def _(logger: WandbLogger, name, image, step):
    logger.log_image(name, [image], step)


@show_picture.register
def _(logger: MLFlowLogger, name, image, step):
    logger.experiment.log_image(logger.run_id, image, artifact_file=f"{name}/{step:08d}.png")


@show_mesh.register
def _(logger: CSVLogger | WandbLogger | MLFlowLogger, name, vertices, faces, up, step):
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(logger.log_dir) / name if isinstance(logger, CSVLogger) else Path(scratch)
        write_row([Mesh(vertices, faces)], up, path := folder / f"{step:08d}.glb")
        if isinstance(logger, MLFlowLogger):
            logger.experiment.log_artifact(logger.run_id, str(path), artifact_path=name)
        elif isinstance(logger, WandbLogger):
            import wandb  # an extra

            logger.log_metrics({name: wandb.Object3D(str(path))}, step)  # type: ignore[dict-item]  # a copy
