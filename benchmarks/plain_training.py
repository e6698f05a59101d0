"""`train.py` with every step as a textbook writes it: what sdfhub's fast path must be as good as.

    python benchmarks/plain_training.py activation=hosc encoding=fourier scale=tiny

The code is copied to every point, activations are PyTorch's own functions, gradients in space come from a
double backward, and the whole batch is one piece on PyTorch's own threads. Data, optimiser, schedule and
judging stay sdfhub's. `accuracy.py` runs it beside `train.py`; a test holds the two objectives equal.
"""

import sdfhub  # noqa: F401  (before torch: it says how threads wait)

# isort: split
import sys
from itertools import zip_longest

import torch
import torch.nn.functional as F
from torch import Tensor

from sdfhub.errors import SdfhubError
from sdfhub.model.autodecoder import AutoDecoder
from sdfhub.model.conditioning import Concat
from sdfhub.model.decoder import Decoder
from sdfhub.model.fast.pieces import Parts
from sdfhub.shapes import Batch
from sdfhub.tasks.command import main as command


def field(decoder: Decoder, points: Tensor, codes: Tensor) -> Tensor:
    """Signed distances [B, N] at points [B, N, 3] of shapes with codes [B, L], conditioned by concatenation.

    Raises:
        SdfhubError: the codes enter in another way.
    """
    encoded, copied = decoder.encoding(points), codes[:, None].expand(-1, points.shape[1], -1)
    hidden = encoded[..., :0]
    for layer, activation in zip_longest(decoder.layers, decoder.activations):
        if type(layer) is not Concat:
            raise SdfhubError("plain_training.py is written for conditioning=concat alone")
        _, reads_points, reads_code = layer.columns
        given = [hidden, encoded[..., :reads_points], copied[..., :reads_code]]
        hidden = layer.linear(torch.cat(given, dim=-1))
        if activation is not None:
            hidden = F.dropout(activation(hidden), decoder.dropout, decoder.training)
    sdf = hidden.squeeze(-1)
    return torch.tanh(sdf) if decoder.tanh else sdf


def objective(model: AutoDecoder, batch: Batch, progress: float) -> tuple[Tensor, Parts]:
    """`AutoDecoder.objective`, written plainly."""
    codes, gradients = model.codes(batch.rows), None
    if batch.surface_points.shape[1] and model.loss.wants_gradients(progress):
        points = batch.surface_points.clone().requires_grad_()
        on_surface = field(model.decoder, points, codes)
        (gradients,) = torch.autograd.grad(on_surface.sum(), points, create_graph=True)
    predicted = field(model.decoder, batch.points, codes)
    parts = model.loss.parts(predicted, batch.sdf, codes, gradients, batch.surface_normals, progress)
    return sum(parts.values()), parts


def main() -> None:
    AutoDecoder.objective = objective
    sys.argv.insert(1, "train")
    command()


if __name__ == "__main__":
    main()
