"""What every fit of codes shares: observations go in, codes come out, the decoder stays as it is."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple, Protocol

from torch import Tensor

from sdfhub.latent.similarity import PoseRange, Similarity
from sdfhub.model.decoder import Decoder
from sdfhub.shapes import Observation

Shapes = Sequence[Observation]
Poses = PoseRange | None  # None where frames are known


class Fitted(NamedTuple):
    """The shapes behind B observations."""

    codes: Tensor  # [B, L]
    residuals: Tensor  # [B] mean violation of the bounds over all points, in the observations' units
    poses: Similarity | None = None  # from their frames to the normalised one; None where that was known


class Fit(Protocol):
    """How codes of observed shapes are found."""

    @property
    def samples(self) -> int | None:
        """Signed samples that an observation of a stored shape should hold; None for all there are."""

    def __call__(
        self, decoder: Decoder, codes: Tensor, observations: Shapes, delta: float, poses: Poses = None
    ) -> Fitted:
        """The shapes behind B observations, each fitted as if it were alone.

        Args:
            decoder: stays as it is; its mode is restored.
            codes: [S, L] of the training shapes.
            observations: B of them; an SdfhubError says that this fit cannot use such.
            delta: clamp of distances in the training, normalised frame, > 0.
            poses: how far unknown frames of observations may be off; None where they are known.
        """


@contextmanager
def frozen(decoder: Decoder) -> Iterator[None]:
    """The decoder in evaluation mode and without gradients of its weights; restored afterwards."""
    training, learning = decoder.training, [p for p in decoder.parameters() if p.requires_grad]
    decoder.eval().requires_grad_(False)
    try:
        yield
    finally:
        for parameter in learning:
            parameter.requires_grad_(True)
        decoder.train(training)
