"""The quick judgement of a few shapes during a training, for monitors and curves."""

from typing import Annotated

import numpy as np
import torch
from pydantic import ConfigDict, Field, NonNegativeInt, PositiveFloat, PositiveInt, SkipValidation
from pydantic.dataclasses import dataclass
from torch import Tensor

from sdfhub.data.loading.datamodule import ValidationShape
from sdfhub.data.store.stored_shape import signed_samples
from sdfhub.errors import SdfhubError
from sdfhub.geometry.metrics import chamfer
from sdfhub.geometry.surface import sample_surface
from sdfhub.latent.fitting import Fit
from sdfhub.model.decoder import Decoder
from sdfhub.model.fast.computing import distances
from sdfhub.shapes import NormalizedMesh, Observation
from sdfhub.space import reconstruct


@dataclass(frozen=True, config=ConfigDict(arbitrary_types_allowed=True))
class Validation:
    """Scores a training shape with its own code, or a held-out one with a code fitted to its samples.

    Coarse and cheap, not for tables. The same samples every time; neither weights nor random states change.
    """

    fit: SkipValidation[Fit]  # finds the codes of held-out shapes
    resolution: Annotated[int, Field(ge=2)] = 64  # points along an axis of the marching-cubes grid
    points: PositiveInt = 10_000  # surface points a side of the Chamfer distance
    delta: PositiveFloat = 0.1  # clamp of distances in the training, normalised frame
    seed: NonNegativeInt = 0  # of all samples

    def __call__(self, decoder: Decoder, item: ValidationShape, codes: Tensor) -> dict[str, float]:
        """The scores of one shape, from a decoder in evaluation mode and codes [S, L].

        `sdf_error`: mean |f - d| over samples with |d| < delta. `cd`: Chamfer distance times 10^3, where the
        shape has a mesh; without a surface that of one point at the origin, so that monitors have a number.
        """
        rows = signed_samples(item.shape, self.fit.samples or self.points, np.random.default_rng(self.seed))
        with torch.inference_mode(False), torch.no_grad():  # fits need derivatives
            seen, codes = Observation.of_samples(rows[:, :3], rows[:, 3]), codes.detach()
            row = item.row
            code = codes[row] if row is not None else self.fit(decoder, codes, [seen], self.delta).codes[0]
            near = torch.from_numpy(rows[np.abs(rows[:, 3]) < self.delta]).to(code.device)
            field = distances(decoder, near[None, :, :3], code[None])[0]
            scores = {"sdf_error": float((field - near[:, 3]).abs().mean())}
            if (truth := item.shape.mesh) is not None:
                scores["cd"] = 1e3 * self._chamfer(decoder, code, truth)
        return scores

    def _chamfer(self, decoder: Decoder, code: Tensor, truth: NormalizedMesh) -> float:
        expected, _ = sample_surface(truth.vertices, truth.faces, self.points, (self.seed, 0))
        try:
            vertices, faces = next(reconstruct(decoder, code[None], self.resolution))
            points, _ = sample_surface(vertices, faces, self.points, (self.seed, 2))
        except (SdfhubError, ValueError):  # a field that is not finite, a mesh without area
            points = np.zeros((1, 3))
        return chamfer(points, expected)
