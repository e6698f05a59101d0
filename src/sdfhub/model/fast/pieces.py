"""A large batch in pieces: the gradient of the whole in the memory of a part, on all cores.

At once the activations of DeepSDF's batch, a million points, would take tens of gigabytes.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import partial

import torch
from torch import Tensor

from sdfhub.model.dropout import drawn_from
from sdfhub.model.fast.side_by_side import side_by_side
from sdfhub.shapes import Batch

Parts = dict[str, Tensor]  # weighted terms of the loss by name; their sum is the loss
Share = Sequence[Callable[[], Parts]]  # the pieces of one thread


def pieces(batch: Batch, points: int) -> Iterator[tuple[Batch, float, float]]:
    """Batches of at most `points` samples that make up a batch, with their shares of samples and of normals:
    of several whole shapes where those fit, else parts of one shape."""
    shapes, samples = batch.sdf.shape
    surface = max(1, batch.surface_points.shape[1])
    together, cuts = max(1, points // samples), -(-samples // points)
    for first in range(0, shapes, together):
        rows = slice(first, first + together)
        arrays = [getattr(batch, name)[rows].tensor_split(cuts, dim=1) for name in batch.__match_args__[1:]]
        for columns in zip(*arrays, strict=True):
            piece = Batch(batch.rows[rows], *columns)
            share = len(piece.rows) / shapes
            yield piece, share * piece.sdf.shape[1] / samples, share * piece.surface_points.shape[1] / surface


def loss_in_pieces(
    parts_of: Callable[[Batch], Parts], batch: Batch, points: int, learned: Sequence[Tensor], threads: int = 1
) -> tuple[Tensor, Parts]:
    """The loss of a batch and its parts; the plain twin is `parts_of(batch)`.

    A batch of more than `points` samples is differentiated by what is learned in here, piece by piece, by
    each thread pieces of its own; `backward` only hands the sum over. Parts are weighted means: over surface
    points the one named `normal`, else over samples or shapes.
    """
    if batch.sdf.numel() <= points:
        parts = parts_of(batch)
        return torch.stack(tuple(parts.values())).sum(), parts

    def weighted(piece: Batch, of_samples: float, of_normals: float, seed: int | None) -> Parts:
        with drawn_from(seed):
            parts = parts_of(piece)
        return {name: part * (of_normals if name == "normal" else of_samples) for name, part in parts.items()}

    cut = list(pieces(batch, points))
    # drawn here, in order: threads take turns as they like
    seeds = torch.randint(2**63 - 1, (len(cut),)).tolist() if batch.sdf.is_cpu else [None] * len(cut)
    calls = [partial(weighted, *piece, seed) for piece, seed in zip(cut, seeds, strict=True)]
    shares = [share for thread in range(threads) if (share := calls[thread::threads])]
    totals: Parts = {}
    return _Summed.apply(shares, totals, *learned), totals


class _Summed(torch.autograd.Function):
    """The sum of losses, differentiated while it is summed, so that one graph a thread lives at a time."""

    @staticmethod
    def forward(ctx, shares: Sequence[Share], totals: Parts, *learned: Tensor) -> Tensor:
        sums = side_by_side(lambda share: _differentiated(share, learned), shares)
        (parts, ctx.gradients), *rest = sums
        totals.update(parts)
        for parts, gradients in rest:
            torch._foreach_add_(ctx.gradients, gradients)
            for name, part in parts.items():
                totals[name] = totals[name] + part
        return torch.stack(tuple(totals.values())).sum()

    @staticmethod
    def backward(ctx, by_loss: Tensor):
        return None, None, *torch._foreach_mul(ctx.gradients, by_loss)


def _differentiated(share: Share, learned: Sequence[Tensor]) -> tuple[Parts, list[Tensor]]:
    """Sums of the parts of the loss over pieces, and its gradient, one piece after the other."""
    totals: Parts = {}
    gradients = [torch.zeros_like(parameter) for parameter in learned]
    for parts_of_piece in share:
        with torch.enable_grad():
            parts = parts_of_piece()
            loss = torch.stack(tuple(parts.values())).sum()
        with torch.autocast(loss.device.type, enabled=False):  # as Lightning calls backward
            torch._foreach_add_(gradients, torch.autograd.grad(loss, learned, materialize_grads=True))
        for name, part in parts.items():
            totals[name] = totals.get(name, torch.zeros_like(part)) + part.detach()
    return totals, gradients
