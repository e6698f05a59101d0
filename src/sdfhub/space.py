"""A trained shape space as a library: signed distances, meshes and codes of its shapes, without its trainer.

>>> space = sdfhub.load(run)
>>> space.ids[0], space.codes.shape
('balls/small', torch.Size([4, 4]))
>>> vertices, faces = space.mesh("balls/small", resolution=32)
>>> points = (2 * torch.rand(2000, 3) - 1).requires_grad_()
>>> distances = space.sdf(points, "balls/small")
>>> outward = torch.autograd.grad(distances.sum(), points)[0]
>>> code = space.fit(points=points.detach(), sdf=distances.detach())
>>> between = space.interpolate("balls/small", code, steps=5)
>>> len(list(space.meshes(between, resolution=16)))
5
>>> space.sample(3, seed=0).shape
torch.Size([3, 4])

A shape is an id, a row of the code table, or a code. Points are in the normalised frame, meshes in their
source's.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from functools import cached_property
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from sdfhub.errors import SdfhubError
from sdfhub.geometry.mesher import Mesh, mesh_fields
from sdfhub.latent.fitting import Fit, Fitted
from sdfhub.latent.gauss_newton import GaussNewtonFit
from sdfhub.latent.gaussian import Gaussian
from sdfhub.model.decoder import Decoder
from sdfhub.model.fast.computing import distances
from sdfhub.scans.evidence import Evidence
from sdfhub.scans.observed_scan import observe
from sdfhub.scans.scan import Scan
from sdfhub.shapes import NORMALIZED, Frame, Observation, check_id

Array = np.ndarray | Tensor
Shape = str | int | Array  # an id, a row of the code table, or a code [L]
ScanFrame = Literal["shape", "normalised"] | Frame


@dataclass(frozen=True, eq=False, repr=False)
class Space:
    """A decoder, the codes of the shapes it was trained on, and what is known of them."""

    decoder: Decoder  # f_theta, in evaluation mode, its weights without gradients
    codes: Tensor  # [S, L] float32, on the decoder's device
    ids: tuple[str, ...]  # of the S shapes, in the order of the codes
    frames: Mapping[str, Frame]  # where shapes lie in their sources' frames, as far as it is known
    up: Literal["y", "z"]  # the axis that points up in the source's frame, for pictures
    model: dict[str, Any]  # what its model is made of: plain data
    config: dict[str, Any]  # what the training was composed of: plain data
    metrics: dict[str, Any] | None  # what `metrics.json` of the run holds; None where nothing was judged
    delta: float = 0.1  # clamp of distances in the training; codes of other shapes are fitted under the same
    evidence: Evidence = field(default_factory=Evidence)  # makes observations of scans
    fitter: Fit = field(default_factory=GaussNewtonFit)  # finds the codes behind observations

    def __repr__(self) -> str:
        return f"Space({len(self.ids)} shapes, codes of {self.codes.shape[1]} numbers, {self.up} up)"

    def __post_init__(self):
        for id in self.ids:
            check_id(id)
        wanted = (len(self.ids), self.decoder.code_size)
        if self.codes.shape != wanted or not self.ids:
            raise ValueError(f"codes: expected {wanted}, at least one, got {tuple(self.codes.shape)}")
        if self.codes.dtype != torch.float32 or not torch.isfinite(self.codes).all():
            raise ValueError("codes: must be finite float32 numbers")
        if len(set(self.ids)) < len(self.ids) or not self.frames.keys() <= set(self.ids):
            raise ValueError("ids: must differ, and frames belong to them")
        if self.up not in ("y", "z"):
            raise ValueError(f"up: must be y or z, got {self.up!r}")

    @property
    def device(self) -> torch.device:
        """Where the codes and the decoder are."""
        return self.codes.device

    def row(self, shape: str | int | np.integer) -> int:
        """The row of a shape in the code table."""
        if isinstance(shape, str):
            if shape in self.ids:
                return self.ids.index(shape)
            near = ", ".join(get_close_matches(shape, self.ids, n=3, cutoff=0))
            raise SdfhubError(f"this space was not trained on a shape {shape!r}; it has {near} ...")
        if isinstance(shape, bool) or not 0 <= shape < len(self.ids):
            raise SdfhubError(f"this space has no row {shape}; its rows are 0 to {len(self.ids) - 1}")
        return int(shape)

    def code(self, shape: Shape | Sequence[Shape]) -> Tensor:
        """The code [L] of a shape, or the codes [B, L] of several."""
        if isinstance(shape, str | int | np.integer):
            return self.codes[self.row(shape)]
        if isinstance(shape, Sequence) and len(shape):
            return torch.stack([self._single_code(item) for item in shape])
        code, size = self._tensor(shape), self.codes.shape[1]
        if code.dim() not in (1, 2) or code.shape[-1] != size:
            raise SdfhubError(f"a shape is an id, row or tensor of {size} numbers; got {list(code.shape)}")
        return code

    def _single_code(self, shape: Shape) -> Tensor:
        code = self.code(shape)
        if code.dim() != 1:
            raise SdfhubError("expected one shape, got several")
        return code

    def frame(self, shape: Shape) -> Frame:
        """Where a shape lies in its source's frame; the normalised frame itself where that is not known."""
        if not isinstance(shape, str | int | np.integer):
            return NORMALIZED
        return self.frames.get(self.ids[self.row(shape)], NORMALIZED)

    def sdf(self, points: Array, shape: Shape | Sequence[Shape]) -> Tensor:
        """Signed distances [N] at points [N, 3] of one shape, or [B, N] at [B, N, 3] of B; negative inside.

        Points are in the normalised frame. Differentiable by points and codes, as often as the decoder is.
        """
        points, codes = self._tensor(points), self.code(shape)
        if points.dim() < 2 or points.shape != (*codes.shape[:-1], points.shape[-2], 3):
            what = f"points {list(points.shape)} and codes {list(codes.shape)}"
            raise SdfhubError(f"sdf takes points [N, 3] of one shape or [B, N, 3] of B shapes, got {what}")
        if not points.numel():
            return points.new_zeros(points.shape[:-1])
        batch = points.reshape(-1, *points.shape[-2:]), codes.reshape(-1, codes.shape[-1])
        differentiated = torch.is_grad_enabled() and (points.requires_grad or codes.requires_grad)
        sdf = self.decoder(*batch) if differentiated else distances(self.decoder, *batch)
        return sdf.reshape(points.shape[:-1])

    def mesh(self, shape: Shape, resolution: int = 256) -> Mesh:
        """The surface of a shape, [V, 3] and [F, 3], in its source's frame; of a code in the normalised one.

        From a grid of `resolution` >= 2 points along an axis; V = F = 0 where the field has no zero level.
        """
        return next(self.meshes([shape], resolution))

    def meshes(self, shapes: Sequence[Shape] | Tensor, resolution: int = 256) -> Iterator[Mesh]:
        """The surfaces of several shapes, worked out together, each as `mesh` gives it."""
        codes = self.code(shapes)
        if codes.dim() != 2:
            raise SdfhubError("meshes: takes several shapes, a list or codes [S, L]; mesh takes one")
        meshes = reconstruct(self.decoder, codes, resolution)
        for shape, (vertices, faces) in zip(shapes, meshes, strict=True):
            yield Mesh(self.frame(shape).to_source(vertices), faces)

    def fit(
        self,
        points: Array,
        normals: Array | None = None,
        sdf: Array | None = None,
        frame: ScanFrame = "normalised",
        seed: int = 0,
    ) -> Tensor:
        """The code [L] of a shape that the space has not seen, by MAP estimation.

        Args:
            points: [N, 3], all over the surface where `sdf` is not given.
            normals: [N, 3] outward normals of surface points.
            sdf: [N] signed distances at the points, negative inside, of both sides.
            frame: in which points lie: normalised; a known one, such as `space.frames[id]`; shape, as their
                bounding box tells.
            seed: of the choice of points.

        Raises:
            SdfhubError: they do not tell a shape.
        """
        if sdf is not None and normals is not None:
            raise SdfhubError("fit: normals belong to surface points; give them or sdf, not both")
        try:
            scan = Scan(_numbers(points), normals=_numbers(normals), sdf=_numbers(sdf))
            return self.fit_scan(scan, frame, seed)
        except (TypeError, ValueError, SdfhubError) as error:
            raise SdfhubError(f"fit: {error}") from error

    def fit_scan(self, scan: Scan, frame: ScanFrame = "shape", seed: int = 0) -> Tensor:
        """The code [L] of a scan from a file or from arrays; frame and seed are as for `fit`."""
        if not isinstance(frame, Frame) and frame not in ("shape", "normalised"):
            raise SdfhubError(f"frame={frame!r}: must be 'shape', 'normalised' or a Frame")
        frame = NORMALIZED if frame == "normalised" else frame
        seen = observe(scan, self.evidence, frame, np.random.default_rng(seed))
        return self.fit_observations([seen.observation]).codes[0]

    def fit_observations(self, observations: Sequence[Observation]) -> Fitted:
        """Codes [B, L] and residuals [B] of the shapes behind B observations in the normalised frame."""
        return self.fitter(self.decoder, self.codes, observations, self.delta)

    def interpolate(self, a: Shape, b: Shape, steps: int) -> Tensor:
        """Codes [steps, L] in equal steps along the line from a to b, both included; steps >= 2."""
        _check_count("steps", steps, 2)
        share = torch.linspace(0, 1, steps, device=self.device)[:, None]
        return torch.lerp(self._single_code(a)[None], self._single_code(b)[None], share)

    def neighbours(self, shape: Shape, k: int = 5) -> list[tuple[str, float]]:
        """Ids of the k shapes with the nearest codes, and how far they are; a shape is not its own."""
        _check_count("k", k, 1)
        own = self.row(shape) if isinstance(shape, str | int | np.integer) else None
        distances = (self.codes - self._single_code(shape).detach()).norm(dim=1).tolist()
        nearest = sorted((value, row) for row, value in enumerate(distances) if row != own)
        return [(self.ids[row], value) for value, row in nearest[:k]]

    def unusual(self, shape: Shape | Sequence[Shape]) -> Tensor:
        """Squared distances, [] or [B], of codes to the mean of the known ones: of these about 1."""
        codes = self.code(shape)
        return self.distribution.unusual(codes.reshape(-1, codes.shape[-1])).reshape(codes.shape[:-1])

    @cached_property
    def distribution(self) -> Gaussian:
        """The normal distribution of the codes."""
        return Gaussian.of(self.codes)

    @property
    def principal_directions(self) -> Tensor:
        """[K, L] principal axes of the codes, each one standard deviation long, the longest first."""
        return self.distribution.axes

    def sample(self, n: int, seed: int = 0) -> Tensor:
        """Codes [n, L] of new shapes, drawn from the distribution of the known ones."""
        _check_count("n", n, 1)
        _check_count("seed", seed, 0)
        return self.distribution.sample(n, seed)

    def _tensor(self, array: Array | Sequence[Any]) -> Tensor:
        try:
            plain = array if isinstance(array, Tensor) else np.array(array)  # torch takes no reversed view
            return torch.as_tensor(plain, dtype=torch.float32, device=self.device)
        except (TypeError, ValueError, RuntimeError) as error:
            raise SdfhubError(f"expected an array or tensor of numbers, got {array!r:.60}") from error


def _check_count(name: str, value: int, least: int) -> None:
    if not isinstance(value, int | np.integer) or value < least:
        raise SdfhubError(f"{name}={value!r}: must be a whole number, at least {least}")


def _numbers(array: Any) -> Any:
    array = array.detach().cpu().numpy() if isinstance(array, Tensor) else array
    return None if array is None else np.array(array, np.float64)


def reconstruct(decoder: Decoder, codes: Tensor, resolution: int) -> Iterator[Mesh]:
    """The zero levels of f(., z) of codes [S, L], normalised frame, meshed together; empty without one."""
    _check_count("resolution", resolution, 2)
    fields = lambda points, shapes: distances(decoder, points, codes[shapes])  # noqa: E731
    try:
        yield from mesh_fields(fields, len(codes), resolution, device=codes.device)
    except MemoryError as error:
        raise SdfhubError(f"resolution={resolution}: there is not enough memory for its grid") from error
