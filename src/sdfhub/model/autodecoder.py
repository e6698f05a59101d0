"""The LightningModule: wires decoder, codes, loss and optimiser, and logs. No formula lives here."""

import math
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Self

import lightning as L
import torch
from torch import Tensor

from sdfhub.checkpoint_file import read_checkpoint
from sdfhub.described import describe
from sdfhub.errors import SdfhubError
from sdfhub.model.codes import CodeTable
from sdfhub.model.decoder import Decoder
from sdfhub.model.fast.computing import Computing
from sdfhub.model.fast.pieces import Parts, loss_in_pieces
from sdfhub.model.losses import Loss, SdfLoss
from sdfhub.model.optimisers import Optimisation
from sdfhub.model.saved import built_parts, model_with_weights
from sdfhub.shapes import Batch


class AutoDecoder(L.LightningModule):
    """A decoder and a table of codes, trained together on batches of shapes.

    Its hyper-parameters are plain data, from which `load_from_checkpoint` makes the same objects.

    Source: Park et al. 2019, section 4.2; the paper's final loss.

    Args:
        decoder: f_theta(x, z).
        shapes: S, rows of the code table, >= 1; `SdfDataModule.rows` tells how many there are.
        codes: makes the table, called with `shapes` and `size`.
        loss: the objective and its weights.
        optim: an `Optimisation`, or a partial of an optimiser (`Optimisation.of`).
        computing: how steps are computed; by default as the device likes it.
        validation: scores a shape of `val_dataloader`; None validates nothing.
        seed: a step's randomness derives from it and the step's number, so that a resumed run repeats an
            uninterrupted one.
    """

    def __init__(
        self,
        decoder: Decoder,
        shapes: int,
        codes: Callable[..., CodeTable] = CodeTable,
        loss: Loss | None = None,
        optim: Optimisation | partial | None = None,
        computing: Computing | None = None,
        validation: Callable[..., dict[str, float]] | None = None,
        seed: int = 0,
    ):
        super().__init__()
        self.decoder, self.codes = decoder, codes(shapes=shapes, size=decoder.code_size)
        self.loss, self.optim = loss or SdfLoss(), Optimisation.of(optim or Optimisation())
        self.computing, self.validation, self.seed = computing or Computing(), validation, seed
        parts = {"decoder": decoder, "codes": codes, "loss": self.loss, "optim": self.optim}
        parts |= {"computing": self.computing, "validation": validation, "shapes": shapes, "seed": seed}
        self.save_hyperparameters({name: describe(part, name) for name, part in parts.items()}, logger=False)
        self.steps = math.inf
        self._value, self._value_and_gradient = decoder.forward, decoder.value_and_gradient
        self._step_started = time.perf_counter()

    @classmethod
    def load_from_checkpoint(
        cls, checkpoint_path: Any, map_location: Any = "cpu", *_, trust=(), **__
    ) -> Self:
        """The model of a checkpoint with its weights. Runs no code of the file.

        Args:
            checkpoint_path: that a training wrote, such as RUN/checkpoints/last.ckpt.
            map_location: device of the weights.
            trust: packages beside sdfhub whose classes the checkpoint may name.
        """
        path = Path(checkpoint_path)
        content = read_checkpoint(path, map_location)
        parameters = content.get("hyper_parameters")
        make = lambda: cls(**built_parts(parameters, path, trust))  # noqa: E731
        return model_with_weights(make, parameters, content.get("state_dict"), path).to(map_location)

    def forward(self, points: Tensor, rows: Tensor) -> Tensor:
        """Signed distances [B, N] at points [B, N, 3], normalised frame, of the shapes in table rows [B]."""
        return self.decoder(points, self.codes(rows))

    def on_fit_start(self) -> None:
        self.decoder.encoding = self.computing.quickest(self.decoder.encoding, self.device)
        self.computing.set_up(self.device)
        passes = self.decoder.forward, self.decoder.value_and_gradient
        self._value, self._value_and_gradient = self.computing.compiled(*passes, device=self.device)

    def on_fit_end(self) -> None:
        # Lightning has moved the model to the CPU by now, and of the plain encoding its weights alone
        self.decoder.encoding = self.decoder.encoding.plain().to(self.device)
        torch.set_float32_matmul_precision("highest")  # what is trained is judged with all its digits

    def on_train_batch_start(self, batch: Batch, batch_idx: int) -> None:
        batches = self.trainer.accumulate_grad_batches
        torch.manual_seed((self.seed << 32) + self.global_step * batches + batch_idx % batches)
        self._step_started = time.perf_counter()

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        loss, parts = self.objective(batch, self.progress)
        self._refuse_divergence("loss", {name: part.detach() for name, part in parts.items()})
        every = self.trainer.log_every_n_steps  # type: ignore[attr-defined] # 0: nothing is logged
        if every and (self.global_step + 1) % every == 0:
            self._log(batch, parts, loss)
        return loss

    def objective(self, batch: Batch, progress: float) -> tuple[Tensor, Parts]:
        """The loss of a batch at a share of training in [0, 1], and its weighted parts, whose sum it is."""
        device = batch.sdf.device
        limit, threads = self.computing.together(device, batch.sdf.numel()), self.computing.threads(device)
        learned = [parameter for parameter in self.parameters() if parameter.requires_grad]
        self.codes.shorten()
        return loss_in_pieces(lambda piece: self._parts(piece, progress), batch, limit, learned, threads)

    def _parts(self, batch: Batch, progress: float) -> Parts:
        codes = self.codes.table[batch.rows]
        predicted = self._value(batch.points, codes)
        gradients = None
        if batch.surface_points.shape[1] and self.loss.wants_gradients(progress):
            _, gradients = self._value_and_gradient(batch.surface_points, codes)
        return self.loss.parts(predicted, batch.sdf, codes, gradients, batch.surface_normals, progress)

    def validation_step(self, shape: Any, batch_idx: int) -> None:
        """Scores one shape of `val_dataloader`: `val/...` of held-out shapes, `train/...` of known ones."""
        if self.validation:
            scores = self.validation(self.decoder, shape, self.codes.table)
            role = "val" if shape.role == "held_out" else "train"
            named = {f"{role}/{name}": value for name, value in scores.items()}
            self.log_dict(named, batch_size=1, on_epoch=True, sync_dist=self.trainer.world_size > 1)

    @property
    def progress(self) -> float:
        """Share of training done, in [0, 1]."""
        return min(1.0, self.global_step / self.steps)

    def configure_optimizers(self):
        self.steps = self.trainer.estimated_stepping_batches
        # this has opened the data loader; a resumed training opens it again, once it knows its step
        self.trainer.fit_loop._combined_loader = None
        if math.isinf(self.steps):
            raise SdfhubError("trainer.max_epochs: set it or max_steps; schedules are shares of a training")
        weights = self.decoder.parameters(), self.codes.parameters()
        matrices = self.decoder.hidden_matrices()
        optimizer, schedule = self.optim.configure(*weights, int(self.steps), matrices)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def configure_gradient_clipping(self, _, gradient_clip_val=None, gradient_clip_algorithm=None) -> None:
        # Lightning clips no gradients of a fused optimiser under mixed precision, for fear of a loss scale
        if gradient_clip_val is not None and gradient_clip_val > 0:
            by_value = gradient_clip_algorithm == "value"
            clip = torch.nn.utils.clip_grad_value_ if by_value else torch.nn.utils.clip_grad_norm_
            clip(self.parameters(), gradient_clip_val)

    def on_before_optimizer_step(self, optimizer) -> None:
        weights = self.named_parameters()
        self._refuse_divergence("gradient", {name: p.grad for name, p in weights if p.grad is not None})

    def on_save_checkpoint(self, checkpoint: dict) -> None:
        self._refuse_divergence("model", dict(self.named_parameters()))

    def _refuse_divergence(self, what: str, parts: Mapping[str, Tensor]) -> None:
        if torch.isfinite(torch.nn.utils.get_total_norm(parts.values())):
            return
        wrong = [name for name, part in parts.items() if not torch.isfinite(part).all()]
        where = f"at step {self.global_step} ({', '.join(wrong[:3]) or 'its norm'})"
        hint = "lower optim.lr_decoder, activation.omega_0, activation.beta or normals.tau"
        raise SdfhubError(f"{what} is not finite {where}: the run diverged; {hint}")

    def _log(self, batch: Batch, parts: dict[str, Tensor], loss: Tensor) -> None:
        values = {f"loss/{name}": float(part.detach()) for name, part in parts.items()}
        values["codes/norm"] = float(self.codes.table[batch.rows].detach().norm(dim=-1).mean())
        for index, activation in enumerate(self.decoder.activations):
            values |= {f"{name}/layer_{index}": value for name, value in activation.monitored().items()}
        shared = self.trainer.world_size > 1  # processes then log the mean over their shares of the batch
        self.log("loss/total", loss.detach(), prog_bar=True, sync_dist=shared)
        self.log_dict(values, sync_dist=shared)

    def on_train_batch_end(self, outputs, batch: Batch, batch_idx: int) -> None:
        seconds = time.perf_counter() - self._step_started
        self.log("speed/samples_per_second", batch.sdf.numel() * self.trainer.world_size / seconds)
