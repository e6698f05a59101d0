"""What every fit of codes shares: observations go in, codes come out, the decoder stays as it is."""

from collections.abc import Callable, Iterator, Sequence
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
    if is_cpu(device):
        return joined(side_by_side(lambda observation: fit([observation]), observations, least=1))
    rows: dict[tuple[int, bool], list[int]] = {}
    for row, observation in enumerate(observations):
        rows.setdefault((len(observation.points), observation.is_exact), []).append(row)
    codes, residuals, poses = joined([fit([observations[row] for row in group]) for group in rows.values()])
    order = torch.tensor([row for group in rows.values() for row in group], device=device).argsort()
    poses = Similarity(*(part[order] for part in poses)) if poses else None
    return Fitted(codes[order], residuals[order], poses)


def is_cpu(device: torch.device) -> bool:
    """Whether shapes are fitted one by one, a thread each."""
    return device.type == "cpu"


def joined(parts: Sequence[Fitted]) -> Fitted:
    """The fits of several groups of shapes as one."""
    poses = [part.poses for part in parts if part.poses is not None]
    return Fitted(
        torch.cat([part.codes for part in parts]),
        torch.cat([part.residuals for part in parts]),
        Similarity(*map(torch.cat, zip(*poses, strict=True))) if poses else None,
    )


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
