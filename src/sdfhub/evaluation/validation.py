"""The quick judgement of a few shapes during a training, for monitors and curves."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from sdfhub.data.loading.batches import signed_samples
from sdfhub.errors import SdfhubError
from sdfhub.geometry.metrics import chamfer, sample_surface
from sdfhub.latent.fitting import Fit
from sdfhub.model.decoder import Decoder
from sdfhub.model.fast.computing import distances
from sdfhub.shapes import NormalizedMesh, Observation
from sdfhub.space import reconstruct

if TYPE_CHECKING:
    from sdfhub.data.loading.datamodule import ValidationShape  # Lightning's, which spaces do without


@dataclass(frozen=True)
class Validation:
    """Scores a training shape with its own code, or a held-out one with a code fitted to its samples.

    It is coarse, to cost little: good for comparing states of one training, not for tables. The same samples
    are drawn every time. It changes neither weights nor random states of a training.

    Args:
        fit: finds the codes of held-out shapes.
        resolution: points along an axis of the marching-cubes grid, >= 2.
        points: surface points a side of the Chamfer distance, >= 1.
        delta: clamp of distances in the training, normalised frame, > 0.
        seed: of all samples.
    """

    fit: Fit
    resolution: int = 64
    points: int = 10_000
    delta: float = 0.1
    seed: int = 0

    def __post_init__(self):
        if self.resolution < 2 or self.points < 1 or self.delta <= 0:
            raise ValueError("validation: resolution must be at least 2, points at least 1, delta positive")

    def __call__(self, decoder: Decoder, item: "ValidationShape", codes: Tensor) -> dict[str, float]:
        """The scores of one shape.

        Args:
            decoder: in evaluation mode.
            item: the shape.
            codes: [S, L] code table.

        Returns:
            `sdf_error`: mean |f - d| over samples with |d| < delta, normalised units. `cd`: Chamfer distance
            times 10^3, squared normalised units, where the shape has a mesh. A reconstruction without surface
            counts as one point at the origin, far worse than any other, so that monitors have a number.
        """
        rows = signed_samples(item.shape, self.fit.samples or self.points, np.random.default_rng(self.seed))
        with torch.inference_mode(False), torch.no_grad():  # fits need derivatives
            codes = codes.detach()
            code = codes[item.row] if item.row is not None else self._fitted(decoder, codes, rows)
            scores = {"sdf_error": self._sdf_error(decoder, code, rows)}
            if (truth := item.shape.mesh) is not None:
                scores["cd"] = 1e3 * self._chamfer(decoder, code, truth)
        return scores

    def _fitted(self, decoder: Decoder, codes: Tensor, rows: np.ndarray) -> Tensor:
        points, sdf = np.ascontiguousarray(rows[:, :3]), np.ascontiguousarray(rows[:, 3])
        observation = Observation(points, sdf, sdf, np.zeros(len(sdf), bool))
        return self.fit(decoder, codes, [observation], self.delta).codes[0]

    def _sdf_error(self, decoder: Decoder, code: Tensor, rows: np.ndarray) -> float:
        near = torch.from_numpy(rows[np.abs(rows[:, 3]) < self.delta]).to(code.device)
        return float((distances(decoder, near[None, :, :3], code[None])[0] - near[:, 3]).abs().mean())

    def _chamfer(self, decoder: Decoder, code: Tensor, truth: NormalizedMesh) -> float:
        want, _ = sample_surface(truth.vertices, truth.faces, self.points, (self.seed, 0))
        try:
            vertices, faces = next(reconstruct(decoder, code[None], self.resolution))
            have, _ = sample_surface(vertices, faces, self.points, (self.seed, 2))
        except (SdfhubError, ValueError):  # a field that is not finite, a mesh without area
            have = np.zeros((1, 3))
        return chamfer(have, want)
