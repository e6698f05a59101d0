"""What every fit of codes shares: observations go in, codes come out, the decoder stays as it is."""

from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from sdfhub.latent.similarity import PoseRange, Similarity
from sdfhub.model.decoder import Decoder
from sdfhub.model.fast.side_by_side import side_by_side
from sdfhub.shapes import Observation


class Fitted(NamedTuple):
    """The shapes behind B observations.

    Args:
        codes: [B, L].
        residuals: [B] mean violation of the bounds over all points, in the observations' units.
        poses: from the observations' frames to the normalised one; None where that was known.
    """

    codes: Tensor
    residuals: Tensor
    poses: Similarity | None = None


class Fit(Protocol):
    """How codes of observed shapes are found.

    Attributes:
        samples: signed samples that an observation of a stored shape should hold; None for all there are.
    """

    @property
    def samples(self) -> int | None: ...

    def __call__(
        self,
        decoder: Decoder,
        codes: Tensor,
        observations: Sequence[Observation],
        delta: float,
        poses: PoseRange | None = None,
    ) -> Fitted:
        """The shapes behind B observations, each fitted as if it were alone.

        Args:
            decoder: stays as it is; its mode is restored.
            codes: [S, L] of the training shapes.
            observations: B of them.
            delta: clamp of distances, normalised frame, > 0: the training's.
            poses: where the observations' frames are unknown: how far they may be off; else None.

        Raises:
            SdfhubError: this fit cannot use such observations.
        """


def fit_groups(
    fit: Callable[[Sequence[Observation]], Fitted], observations: Sequence[Observation], device: torch.device
) -> Fitted:
    """Fits B observations in groups: on a CPU one by one, elsewhere all that are alike at once.

    On a CPU each has a thread of its own, so that no neighbour changes even a rounding.
    """
    groups: dict[Hashable, list[int]] = {}
    for row, observation in enumerate(observations):
        key = row if is_cpu(device) else (len(observation.points), observation.is_exact)
        groups.setdefault(key, []).append(row)
    work = [[observations[row] for row in rows] for rows in groups.values()]
    parts = side_by_side(fit, work, least=1) if is_cpu(device) else list(map(fit, work))
    order = torch.tensor([row for rows in groups.values() for row in rows], device=device).argsort()
    poses = [part.poses for part in parts if part.poses is not None]
    return Fitted(
        torch.cat([part.codes for part in parts])[order],
        torch.cat([part.residuals for part in parts])[order],
        Similarity(*(torch.cat(column)[order] for column in zip(*poses, strict=True))) if poses else None,
    )


def is_cpu(device: torch.device) -> bool:
    """Whether shapes are fitted one by one, a thread each."""
    return device.type == "cpu"


@contextmanager
def frozen(decoder: Decoder) -> Iterator[None]:
    """The decoder in evaluation mode and without gradients of its weights; restored afterwards."""
    training, learning = decoder.training, [p for p in decoder.parameters() if p.requires_grad]
    decoder.eval()
    for parameter in learning:
        parameter.requires_grad_(False)
    try:
        yield
    finally:
        for parameter in learning:
            parameter.requires_grad_(True)
        decoder.train(training)
