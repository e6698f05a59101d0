"""Callbacks that show the first training shapes during a training: meshes beside the truth, and slices."""

from typing import Annotated, Any

import lightning as L
import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from sdfhub.callbacks.media import show_mesh, show_picture
from sdfhub.callbacks.training_record import clock_stopped
from sdfhub.data.store.store import StoredShape
from sdfhub.errors import SdfhubError
from sdfhub.geometry.mesher import sdf_slice
from sdfhub.geometry.metrics import ShapeMetrics, judge
from sdfhub.geometry.render import render, slice_image
from sdfhub.model.autodecoder import AutoDecoder
from sdfhub.model.fast.computing import distances
from sdfhub.shapes import Mesh
from sdfhub.space import reconstruct

METRICS = {"cd": 1e3, "excess": 1e3, "normal_consistency": 1.0, "f_score": 1.0}
"""What `MeshShapes` logs, and the factor of each: Chamfer distances are times 10^3, as in the tables."""

Count = Annotated[int, Field(ge=1)]
GridSize = Annotated[int, Field(ge=2)]


class ShapesShown(L.Callback):
    """Shows the first training shapes several times, evenly over a training, the last time its final state.

    A continued training shows the same steps. The record of the training does not count the seconds spent
    here. Subclasses write `show`.
    """

    def __init__(self, times: Count = 8, shapes: Count = 2):
        self.times, self.shapes = times, shapes
        self._shown_at: int | None = None

    def show(self, trainer: L.Trainer, module: AutoDecoder, shapes: list[StoredShape]) -> None:
        """Shows the shapes of the first rows of the code table; the module is in evaluation mode."""
        raise NotImplementedError

    def on_train_batch_end(self, trainer: L.Trainer, module: Any, *_: Any) -> None:
        step, steps = trainer.global_step, trainer.estimated_stepping_batches  # inf where no end is set
        if step and step * self.times // steps > (step - 1) * self.times // steps:
            self._show(trainer, module)

    def on_train_end(self, trainer: L.Trainer, module: Any) -> None:
        self._show(trainer, module)

    @torch.inference_mode()
    def _show(self, trainer: Any, module: AutoDecoder) -> None:
        if self._shown_at == trainer.global_step or not trainer.is_global_zero:
            return
        self._shown_at, training = trainer.global_step, module.training
        with clock_stopped(trainer):
            module.eval()
            self.show(trainer, module, trainer.datamodule.train_shapes[: self.shapes])
            module.train(training)


class MeshShapes(ShapesShown):
    """Meshes the first training shapes, shows them beside the truth and logs `mesh/cd` and other metrics.

    Shapes without a true mesh are skipped. A field without a surface counts in `mesh/failed`. `resolution`
    counts points along an axis of the marching-cubes grid, `points` those a side of the Chamfer distance.
    """

    def __init__(self, times: Count = 8, shapes: Count = 2, resolution: GridSize = 96, points: Count = 10000):
        super().__init__(times, shapes)
        self.resolution, self.points = resolution, points
        self._truth_pictures: dict[str, np.ndarray] = {}  # of the shapes whose true mesh was shown

    def show(self, trainer: L.Trainer, module: AutoDecoder, shapes: list[StoredShape]) -> None:
        pairs = zip(shapes, module.codes.table, strict=False)
        metrics = [self._show_shape(trainer, module, *pair, mesh) for pair in pairs if (mesh := pair[0].mesh)]
        judged = [scores for scores in metrics if not scores.failed]
        values = {"mesh/failed": float(len(metrics) - len(judged))} if metrics else {}
        for name, factor in METRICS.items() if judged else ():
            values[f"mesh/{name}"] = factor * float(np.mean([getattr(scores, name) for scores in judged]))
        for logger in trainer.loggers:  # not self.log, which drops what lies between two log_every_n_steps
            logger.log_metrics(values, trainer.global_step)

    def _show_shape(self, trainer: Any, module: Any, shape: Any, code: Tensor, truth: Any) -> ShapeMetrics:
        try:
            mesh = next(reconstruct(module.decoder, code[None], self.resolution))
        except SdfhubError:  # the field is not finite: the loss will say so, with a hint
            mesh = Mesh(np.empty((0, 3)), np.empty((0, 3), np.int64))
        if shape.id not in self._truth_pictures:
            self._truth_pictures[shape.id] = render(truth.vertices, truth.faces, up=shape.up)
            for logger in trainer.loggers:
                show_mesh(logger, f"{shape.id}/truth", truth.vertices, truth.faces, shape.up, 0)
        pair = np.hstack([self._truth_pictures[shape.id], render(*mesh, up=shape.up)])
        for logger in trainer.loggers:
            if len(mesh.faces):
                show_mesh(logger, f"{shape.id}/reconstruction", *mesh, shape.up, trainer.global_step)
            show_picture(logger, f"{shape.id}/truth_and_reconstruction", pair, trainer.global_step)
        return judge(mesh, truth, points=self.points)


class Slices(ShapesShown):
    """Shows slices x = 0 of the fields of the first training shapes: inside blue, outside orange."""

    def show(self, trainer: L.Trainer, module: AutoDecoder, shapes: list[StoredShape]) -> None:
        for shape, code in zip(shapes, module.codes.table, strict=False):
            field = lambda points, code=code: distances(module.decoder, points[None], code[None])[0]  # noqa: E731
            try:
                grid = sdf_slice(field, axis=0, device=code.device)
            except SdfhubError:  # as for `MeshShapes`
                continue
            grid = grid if shape.up == "z" else grid[:, ::-1].T  # its first index runs right, z or -z
            image = slice_image(grid, getattr(module.loss, "delta", 0.1))
            for logger in trainer.loggers:
                show_picture(logger, f"{shape.id}/slice_x0", image, trainer.global_step)
