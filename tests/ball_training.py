"""A training of balls in milliseconds: what callbacks, loggers and the validation see of a real one."""

from typing import NamedTuple

import lightning as L
import numpy as np
import torch
import trimesh
from torch import Tensor, nn

from sdfhub.callbacks.checkpoints import WholeFileIO
from sdfhub.evaluation.validation import Validation
from sdfhub.latent.fitting import frozen
from sdfhub.shapes import NormalizedMesh
from tests.test_training import FakeShape

STEPS = 6
"""Of an epoch."""


class Ball(FakeShape):
    """A stored shape: a ball of a given radius, with its mesh or without."""

    up = "z"

    def __init__(self, radius: float, has_mesh: bool = True):
        super().__init__(radius)
        self.id, self.has_mesh = f"balls/{radius}", has_mesh

    @property
    def mesh(self) -> NormalizedMesh | None:
        ball = trimesh.creation.icosphere(3, self.radius)
        faces = np.asarray(ball.faces, np.int64)
        return NormalizedMesh(np.array(ball.vertices), faces) if self.has_mesh else None


class Item(NamedTuple):
    role: str
    row: int | None
    shape: Ball


class BallDecoder(nn.Module):
    """The distance to a ball whose radius is 0.5 + the code's first number + a weight."""

    code_size = 2

    def __init__(self):
        super().__init__()
        self.offset = nn.Parameter(torch.tensor(0.0))

    def forward(self, points: Tensor, codes: Tensor) -> Tensor:
        return points.norm(dim=-1) - (0.5 + codes[:, :1] + self.offset)


class RadiusFit:
    """A fit of the one number that a ball's code has."""

    samples = 500

    def __call__(self, decoder, codes, observations, delta, poses=None):
        with frozen(decoder), torch.enable_grad():
            code = torch.zeros(1, codes.shape[1], requires_grad=True)
            [seen] = observations
            residual = decoder(torch.from_numpy(seen.points)[None], code) - torch.from_numpy(seen.low)
            [gradient] = torch.autograd.grad(residual.mean(), code)
            step = residual.mean() / gradient.square().sum() * gradient
        return type("Fitted", (), {"codes": (code - step).detach()})


class Balls(L.LightningDataModule):
    """Training balls and two to validate on."""

    def __init__(self, shapes: list[Ball] | None = None):
        super().__init__()
        self.train_shapes = shapes or [Ball(0.4), Ball(0.6)]

    def train_dataloader(self):
        return torch.utils.data.DataLoader(range(STEPS), batch_size=None)

    def val_dataloader(self):
        items = [Item("held_out", None, Ball(0.5)), Item("train", 0, self.train_shapes[0])]
        return torch.utils.data.DataLoader(items, batch_size=None, collate_fn=lambda item: item)


class BallModel(L.LightningModule):
    """Moves the radii by `rate` at each step, so that `val/cd` falls at first and rises then.

    The codes do not make up for it: radii start `start` below the true ones.
    """

    def __init__(self, start: float = -0.1, rate: float = 0.01):
        super().__init__()
        self.decoder, self.codes, self.loss = BallDecoder(), nn.Module(), nn.Module()
        self.codes.table = nn.Parameter(torch.tensor([[-0.1, 0.0], [0.1, 0.0]]))
        self.loss.delta, self.rate = 0.1, rate
        self.decoder.offset.data.fill_(start)
        self.validation = Validation(RadiusFit(), resolution=24, points=300)

    def training_step(self, batch, batch_idx):
        loss = -self.rate * self.decoder.offset
        self.log("loss/total", loss)
        return loss

    def validation_step(self, item, batch_idx):
        scores = self.validation(self.decoder, item, self.codes.table)
        role = "val" if item.role == "held_out" else "train"
        self.log_dict({f"{role}/{key}": value for key, value in scores.items()}, batch_size=1)

    def configure_optimizers(self):
        optimizer = torch.optim.SGD([self.decoder.offset], lr=1.0)
        return {"optimizer": optimizer, "lr_scheduler": torch.optim.lr_scheduler.ConstantLR(optimizer, 1.0)}


def trained(*callbacks, data=None, model=None, logger=False, ckpt_path=None, **settings) -> L.Trainer:
    """The trainer of a training, by default of two epochs with a validation each."""
    settings = {"max_epochs": 2, "enable_progress_bar": False, "log_every_n_steps": 1} | settings
    trainer = L.Trainer(
        accelerator="cpu",
        logger=logger,
        callbacks=list(callbacks),
        plugins=WholeFileIO(),
        num_sanity_val_steps=0,
        enable_model_summary=False,
        enable_checkpointing=any(isinstance(c, L.pytorch.callbacks.Checkpoint) for c in callbacks),
        **settings,
    )
    trainer.fit(model or BallModel(), datamodule=data or Balls(), ckpt_path=ckpt_path)
    return trainer
