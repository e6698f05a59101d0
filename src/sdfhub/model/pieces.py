"""A large batch in pieces: the gradient of the whole in the memory of a part.

DeepSDF's paper batch is a million points; the activations of all of them at once would take tens of
gigabytes, and on a CPU even a few thousand leave its caches.
"""

from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor, nn

from sdfhub.shapes import Batch

Parts = dict[str, Tensor]
"""Weighted terms of the loss by name; their sum is the loss."""


def pieces(batch: Batch, points: int) -> Iterator[tuple[Batch, float, float]]:
    """Batches of at most `points` samples that make up a batch, with their shares of samples and of normals.

    Args:
        batch: [B, N] samples, [B, M] surface points.
        points: whole shapes together where several fit, else parts of one shape, >= 1.
    """
    shapes, samples = batch.sdf.shape
    surface = max(1, batch.surface_points.shape[1])
    together, cuts = max(1, points // samples), -(-samples // points)
    for first in range(0, shapes, together):
        some = slice(first, first + together)
        each = [getattr(batch, name)[some].tensor_split(cuts, dim=1) for name in batch.__match_args__[1:]]
        for columns in zip(*each, strict=True):
            piece = Batch(batch.rows[some], *columns)
            part = len(piece.rows) / shapes
            yield (
                piece,
                part * piece.sdf.shape[1] / samples,
                part * piece.surface_points.shape[1] / surface,
            )


def loss_in_pieces(
    parts_of: Callable[[Batch], Parts], batch: Batch, points: int, parameters: Sequence[nn.Parameter]
) -> tuple[Tensor, Parts]:
    """The loss of a batch and its parts, each a mean over samples, normals or shapes; differentiable.

    A batch of more than `points` samples is differentiated at once, piece by piece; `backward`
    only has to hand the sum over. The plain twin is `parts_of(batch)`.

    Args:
        parts_of: the weighted parts of a batch; a part named `normal` is a mean over surface points.
        batch: to be split.
        points: samples that are worked on together, >= 1.
        parameters: what the loss is differentiated by; all take part in it.
    """
    if batch.sdf.numel() <= points:
        parts = parts_of(batch)
        return torch.stack(tuple(parts.values())).sum(), parts
    totals: Parts = {}

    def weighted() -> Iterator[Tensor]:
        for piece, of_samples, of_normals in pieces(batch, points):
            parts = parts_of(piece)
            parts = {
                name: part * (of_normals if name == "normal" else of_samples) for name, part in parts.items()
            }
            for name, part in parts.items():
                totals[name] = totals.get(name, 0) + part.detach()
            yield torch.stack(tuple(parts.values())).sum()

    return _Summed.apply(weighted, *parameters), totals


class _Summed(torch.autograd.Function):
    """The sum of losses, differentiated one by one while it is summed, so that one graph lives at a time."""

    @staticmethod
    def forward(ctx, losses: Callable[[], Iterator[Tensor]], *parameters: Tensor) -> Tensor:
        total, gradients = 0, None
        with torch.enable_grad():
            for loss in losses():
                with torch.autocast(loss.device.type, enabled=False):  # as Lightning calls backward
                    found = torch.autograd.grad(loss, parameters)
                if gradients is None:
                    gradients = list(found)
                else:
                    torch._foreach_add_(gradients, found)
                total = total + loss.detach()
        ctx.gradients = gradients
        return total

    @staticmethod
    def backward(ctx, by_loss: Tensor):
        return None, *torch._foreach_mul(ctx.gradients, by_loss)
