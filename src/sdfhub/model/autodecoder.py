"""The LightningModule: wires decoder, codes, loss and optimiser, and logs. No formula lives here."""

import time
from functools import partial

import lightning as L
import torch
from torch import Tensor

from sdfhub.errors import SdfhubError
from sdfhub.model.codes import CodeTable
from sdfhub.model.decoder import Decoder
from sdfhub.model.fast.computing import Computing
from sdfhub.model.fast.pieces import Parts, loss_in_pieces
from sdfhub.model.losses import Loss
from sdfhub.model.optimisers import Optimisation
from sdfhub.shapes import Batch


class AutoDecoder(L.LightningModule):
    """A decoder and a table of codes, trained together on batches of shapes.

    Source: Park et al. 2019, section 4.2; the paper's final loss.

    Args:
        decoder: f_theta(x, z).
        codes: one row per training shape.
        loss: the objective and its weights.
        optim: makes the optimiser and its schedule; also a partial of an optimiser (`Optimisation.of`).
        steps: optimiser steps of the whole training, for the schedules. It is not asked of the trainer, whose
            answer opens the data loader before a resumed run knows where it stands.
        computing: how steps are computed; by default as the device likes it.
        seed: every step's randomness (dropout) derives from it and the step's number, so that a resumed
            run repeats an uninterrupted one.
    """

    def __init__(
        self,
        decoder: Decoder,
        codes: CodeTable,
        loss: Loss,
        optim: Optimisation | partial,
        steps: int,
        computing: Computing | None = None,
        seed: int = 0,
    ):
        super().__init__()
        self.computing = computing or Computing()
        self._value, self._value_and_gradient = decoder.forward, decoder.value_and_gradient
        self.decoder, self.codes = decoder, codes
        self.optim = Optimisation.of(optim)
        self.loss, self.steps, self.seed = loss, steps, seed
        self._step_started = time.perf_counter()

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
        self.computing.put_back()

    def on_train_batch_start(self, batch: Batch, batch_idx: int) -> None:
        torch.manual_seed((self.seed << 32) + self.global_step)
        self._step_started = time.perf_counter()

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        loss, parts = self.objective(batch, self.progress)
        if not torch.isfinite(loss):
            self._refuse_divergence("loss", parts)
        every = self.trainer.log_every_n_steps  # 0: nothing is logged
        if every and (self.global_step + 1) % every == 0:
            self._log(batch, parts, loss)
        return loss

    def objective(self, batch: Batch, progress: float) -> tuple[Tensor, Parts]:
        """The loss of a batch, which a step lowers, and its weighted parts, whose sum it is.

        Args:
            batch: of training shapes.
            progress: share of training done, in [0, 1].
        """
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

    @property
    def progress(self) -> float:
        """Share of training done, in [0, 1]."""
        return self.global_step / self.steps

    def configure_optimizers(self):
        optimizer, schedule = self.optim.configure(
            self.decoder.parameters(), self.codes.parameters(), self.steps
        )
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def configure_gradient_clipping(
        self, optimizer, gradient_clip_val: float | None = None, gradient_clip_algorithm: str | None = None
    ) -> None:
        # Lightning clips no gradients of a fused optimiser under mixed precision, for fear of a loss scale
        if gradient_clip_val is not None and gradient_clip_val > 0:
            weights = [p for group in optimizer.param_groups for p in group["params"]]
            by_value = gradient_clip_algorithm == "value"
            clip = torch.nn.utils.clip_grad_value_ if by_value else torch.nn.utils.clip_grad_norm_
            clip(weights, gradient_clip_val)

    def on_before_optimizer_step(self, optimizer) -> None:
        gradients = {name: p.grad for name, p in self.named_parameters() if p.grad is not None}
        if not torch.isfinite(torch.nn.utils.get_total_norm(gradients.values())):
            self._refuse_divergence("gradient", gradients)

    def on_save_checkpoint(self, checkpoint: dict) -> None:
        weights = dict(self.named_parameters())
        if not torch.isfinite(torch.nn.utils.get_total_norm(weights.values())):
            self._refuse_divergence("model", weights)

    def _refuse_divergence(self, what: str, parts: dict[str, Tensor]) -> None:
        wrong = [name for name, part in parts.items() if not torch.isfinite(part).all()]
        culprits = f"{', '.join(wrong[:3])}{' ...' * (len(wrong) > 3)}" if wrong else "its norm"
        raise SdfhubError(
            f"{what} is not finite at step {self.global_step} ({culprits}): the run diverged; "
            "lower optim.lr_decoder, activation.omega_0, activation.beta or normals.tau"
        )

    def _log(self, batch: Batch, parts: dict[str, Tensor], loss: Tensor) -> None:
        values = {f"loss/{name}": part.detach() for name, part in parts.items()}
        values["codes/norm"] = self.codes.table[batch.rows].detach().norm(dim=-1).mean()
        for group in self.optimizers().param_groups:
            values[f"lr/{group['name']}"] = group["lr"]
        for index, activation in enumerate(self.decoder.activations):
            values |= {f"{name}/layer_{index}": value for name, value in activation.monitored().items()}
        shared = self.trainer.world_size > 1  # processes then log the mean over their shares of the batch
        self.log("loss/total", loss.detach(), prog_bar=True, sync_dist=shared)
        self.log_dict({name: float(value) for name, value in values.items()}, sync_dist=shared)

    def on_train_batch_end(self, outputs, batch: Batch, batch_idx: int) -> None:
        seconds = time.perf_counter() - self._step_started
        self.log("speed/samples_per_second", batch.sdf.numel() * self.trainer.world_size / seconds)
