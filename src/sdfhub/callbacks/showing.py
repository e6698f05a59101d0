"""What training shows of itself while it runs: meshes, slices and Chamfer distances in TensorBoard."""

import time
from collections import deque

import fast_simplification
import lightning as L
import numpy as np
import torch
from lightning.pytorch.callbacks import TQDMProgressBar
from torch import Tensor

from sdfhub.data.store.stored_shape import StoredShape
from sdfhub.errors import SdfhubError
from sdfhub.geometry.mesher import sdf_slice
from sdfhub.geometry.metrics import judge
from sdfhub.geometry.render import render, slice_image
from sdfhub.model.autodecoder import AutoDecoder
from sdfhub.model.fast.computing import distances
from sdfhub.space import reconstruct

TENSORBOARD_VERTICES = 60_000
"""TensorBoard's mesh plugin indexes vertices with 16 bits and draws garbage beyond 65,535."""


class TrainingRecord(L.Callback):
    """Seconds, steps and the loss at both ends of a training, for `metrics.json`.

    The clock starts after the first step of a process, in which loops are compiled. What an interrupted
    training had gathered by its last checkpoint counts when it is continued.
    """

    ENDS = 20
    """Steps averaged at either end."""

    def __init__(self):
        self._first: list[float | Tensor] = []  # numbers once they are needed: a GPU would be waited for
        self._last: deque[float | Tensor] = deque(maxlen=self.ENDS)
        self._seconds = 0.0  # of all processes before this one; then, once training ends, of all
        self._started: float | None = None
        self._trainer: L.Trainer | None = None
        self.stepped = False  # by this process

    def on_train_start(self, trainer: L.Trainer, module: AutoDecoder) -> None:
        self._trainer = trainer

    def on_train_batch_end(self, trainer: L.Trainer, module: AutoDecoder, outputs, batch, batch_idx) -> None:
        if not self.stepped:
            self.stepped, self._started = True, time.perf_counter()
        self._last.append(outputs["loss"])
        if len(self._first) < self.ENDS:
            self._first.append(outputs["loss"])

    def on_train_end(self, trainer: L.Trainer, module: AutoDecoder) -> None:
        self._seconds, self._started = self._so_far(), None

    def _so_far(self) -> float:
        if self._started is None:
            return self._seconds
        watching = sum(one.seconds for one in self._trainer.callbacks if isinstance(one, MeshShapes))
        return self._seconds + time.perf_counter() - self._started - watching

    def state_dict(self) -> dict:
        ends = {"first": self._first, "last": self._last}
        return {"seconds": self._so_far()} | {end: [float(loss) for loss in ends[end]] for end in ends}

    def load_state_dict(self, state: dict) -> None:
        self._seconds, self._first = float(state["seconds"]), [float(loss) for loss in state["first"]]
        self._last.extend(float(loss) for loss in state["last"])

    def summary(self, model: AutoDecoder) -> dict:
        """Plain numbers: seconds without `MeshShapes` and steps of the whole run, parameters, loss."""
        state = self.state_dict()
        mean = {"start": np.mean(state["first"]), "end": np.mean(state["last"])} if self._last else {}
        return {
            "seconds": self._seconds,
            "steps": model.global_step,
            "parameters": sum(parameter.numel() for parameter in model.decoder.parameters()),
            "loss": {key: float(value) for key, value in mean.items()},
        }


class LossBar(TQDMProgressBar):
    """A progress bar with the loss and without Lightning's version number, which is no number here."""

    def get_metrics(self, trainer: L.Trainer, module: AutoDecoder) -> dict:
        return {key: value for key, value in super().get_metrics(trainer, module).items() if key != "v_num"}


class LossLines(L.Callback):
    """Where nobody watches a bar: a line with the last step's loss at every tenth of a training."""

    def on_train_batch_end(self, trainer: L.Trainer, module: AutoDecoder, outputs, batch, batch_idx) -> None:
        self._loss = outputs["loss"]

    def on_train_epoch_end(self, trainer: L.Trainer, module: AutoDecoder) -> None:
        done, whole = trainer.current_epoch + 1, trainer.max_epochs
        if trainer.is_global_zero and done * 10 // whole > (done - 1) * 10 // whole:
            print(f"epoch {done} of {whole}: loss {float(self._loss):.4g}", flush=True)


class MeshShapes(L.Callback):
    """Every so often: meshes the first shapes, logs their metrics, the meshes beside the truth, and slices.

    A field without a zero crossing is logged (`surface/failed`), never an error.

    Args:
        every_n_epochs: how often, >= 1.
        shapes: how many, from the front of the code table.
        resolution: points along an axis of the marching-cubes grid.
        points: surface points a side of the Chamfer distance.
    """

    METRICS = ("cd", "excess", "normal_consistency", "f_score")

    def __init__(self, every_n_epochs: int, shapes: int, resolution: int, points: int):
        if min(every_n_epochs, shapes, points) < 1 or resolution < 2:
            raise ValueError("every_n_epochs, shapes and points must be at least 1, resolution at least 2")
        self.every_n_epochs, self.shapes = every_n_epochs, shapes
        self.resolution, self.points = resolution, points
        self.seconds = 0.0  # spent here; no part of the training's own time
        self._shown: set[str] = set()

    def on_train_epoch_end(self, trainer: L.Trainer, module: AutoDecoder) -> None:
        if trainer.is_global_zero and (trainer.current_epoch + 1) % self.every_n_epochs == 0:
            start = time.perf_counter()
            self._show(trainer, module)
            self.seconds += time.perf_counter() - start

    @torch.inference_mode()
    def _show(self, trainer: L.Trainer, module: AutoDecoder) -> None:
        shapes = trainer.datamodule.batches.shapes[: self.shapes]
        if any(shape.mesh is None for shape in shapes):
            return  # sources without meshes have nothing to compare with
        module.eval()
        try:
            rows = [self._show_shape(trainer, module, row, shape) for row, shape in enumerate(shapes)]
        finally:
            module.train()
        judged = [row for row in rows if not row.failed]
        values = {
            f"surface/{key}": np.mean([getattr(row, key) for row in judged]) for key in self.METRICS if judged
        }
        values["surface/failed"] = len(rows) - len(judged)
        trainer.logger.log_metrics({key: float(value) for key, value in values.items()}, trainer.global_step)

    def _show_shape(self, trainer: L.Trainer, module: AutoDecoder, row: int, shape: StoredShape):
        writer, step = trainer.logger.experiment, trainer.global_step
        code = module.codes.table[row]
        try:
            [(vertices, faces)] = reconstruct(module.decoder, code[None], self.resolution)
        except SdfhubError:  # a field that is not finite: the loss will say so, with a hint
            vertices, faces = np.empty((0, 3)), np.empty((0, 3), np.int64)
        truth = shape.mesh
        if shape.id not in self._shown:
            self._shown.add(shape.id)
            self._add_mesh(writer, f"{shape.id}/truth", truth.vertices, truth.faces, 0)
        if len(faces):
            self._add_mesh(writer, f"{shape.id}/reconstruction", vertices, faces, step)
            sides = [
                render(*side, up=shape.up) for side in ((truth.vertices, truth.faces), (vertices, faces))
            ]
            writer.add_image(
                f"{shape.id}/truth_and_reconstruction", np.hstack(sides), step, dataformats="HWC"
            )

        def field(points: torch.Tensor) -> torch.Tensor:
            return distances(module.decoder, points[None], code[None])[0]

        grid = sdf_slice(field, axis=0, device=code.device)
        grid = grid if shape.up == "z" else grid[:, ::-1].T  # rows run along the picture's right, z or -z
        writer.add_image(
            f"{shape.id}/slice_x0", slice_image(grid, module.loss.delta), step, dataformats="HWC"
        )
        return judge((vertices, faces), truth, points=self.points)

    @staticmethod
    def _add_mesh(writer, tag: str, vertices: np.ndarray, faces: np.ndarray, step: int) -> None:
        if len(vertices) > TENSORBOARD_VERTICES:
            vertices, faces = fast_simplification.simplify(
                vertices.astype(np.float32), faces, 1 - TENSORBOARD_VERTICES / len(vertices)
            )
        writer.add_mesh(
            tag,
            torch.as_tensor(np.asarray(vertices, np.float32))[None],
            faces=torch.as_tensor(np.asarray(faces, np.int32))[None],
            global_step=step,
        )
