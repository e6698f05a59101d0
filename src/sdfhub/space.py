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
Shape = str | int | Array
"""An id, a row of the code table, or a code [L]."""


@dataclass(frozen=True, eq=False, repr=False)
class Space:
    """A decoder, the codes of the shapes it was trained on, and what is known of them.

    Args:
        decoder: f_theta, in evaluation mode, its weights without gradients.
        codes: [S, L] float32, on the decoder's device.
        ids: of the S shapes, in the order of the codes.
        frames: where shapes lie in their sources' frames, as far as it is known.
        up: the axis that points up in the source's frame, for pictures.
        model: what its model is made of: plain data.
        config: what the training was composed of: plain data.
        metrics: what `metrics.json` of the run holds; None where nothing was judged.
        delta: clamp of distances in the training; codes of other shapes are fitted under the same.
        evidence: makes observations of scans.
        fitter: finds the codes behind observations.
    """

    decoder: Decoder
    codes: Tensor
    ids: tuple[str, ...]
    frames: Mapping[str, Frame]
    up: Literal["y", "z"]
    model: dict[str, Any]
    config: dict[str, Any]
    metrics: dict[str, Any] | None
    delta: float = 0.1
    evidence: Evidence = field(default_factory=Evidence)
    fitter: Fit = field(default_factory=GaussNewtonFit)

    def __repr__(self) -> str:
        return f"Space({len(self.ids)} shapes, codes of {self.codes.shape[1]} numbers, {self.up} up)"

    def __post_init__(self):
        for id in self.ids:
            check_id(id)
        if self.codes.shape != (len(self.ids), self.decoder.code_size) or not len(self.ids):
            wanted = [len(self.ids), self.decoder.code_size]
            raise ValueError(f"codes: expected {wanted}, at least one, got {list(self.codes.shape)}")
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
        """The row of a shape in the code table.

        Raises:
            SdfhubError: there is no such shape; names the id that is spelt most alike.
        """
        if isinstance(shape, str):
            if shape in self.ids:
                return self.ids.index(shape)
            near = get_close_matches(shape, self.ids, n=1)
            hint = f"did you mean {near[0]!r}?" if near else f"it has {', '.join(self.ids[:3])} ..."
            raise SdfhubError(f"this space was not trained on a shape {shape!r}; {hint}")
        if isinstance(shape, bool) or not 0 <= shape < len(self.ids):
            raise SdfhubError(f"this space has no row {shape}; its rows are 0 to {len(self.ids) - 1}")
        return int(shape)

    def code(self, shape: Shape | Sequence[Shape]) -> Tensor:
        """The code [L] of a shape, or the codes [B, L] of several.

        Raises:
            SdfhubError: a shape that is not there, or a code of another size.
        """
        if isinstance(shape, str | int | np.integer):
            return self.codes[self.row(shape)]
        if isinstance(shape, Sequence):
            if not shape:
                raise SdfhubError("no shape is named")
            return torch.stack([self._single_code(item) for item in shape])
        code = self._tensor(shape)
        if code.dim() not in (1, 2) or code.shape[-1] != self.codes.shape[1]:
            what = f"a code is an array or tensor of {self.codes.shape[1]} numbers"
            raise SdfhubError(f"a shape is an id, a row or a code, and {what}; got {list(code.shape)}")
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

        Differentiable by points and codes, as often as the decoder is.

        Args:
            points: normalised frame.
            shape: one, or as many as points has rows.
        """
        points, codes = self._tensor(points), self.code(shape)
        is_one = points.dim() == 2
        if points.shape[-1:] != (3,) or points.dim() != codes.dim() + 1:
            what = f"points {list(points.shape)} and codes {list(codes.shape)}"
            raise SdfhubError(f"sdf takes points [N, 3] of one shape or [B, N, 3] of B shapes, got {what}")
        points, codes = (points[None], codes[None]) if is_one else (points, codes)
        if len(points) != len(codes):
            raise SdfhubError(f"sdf: points of {len(points)} shapes, but codes of {len(codes)}")
        if not points.numel():
            return points.new_zeros(points.shape[1:-1] if is_one else points.shape[:-1])
        differentiated = torch.is_grad_enabled() and (points.requires_grad or codes.requires_grad)
        sdf = self.decoder(points, codes) if differentiated else distances(self.decoder, points, codes)
        return sdf[0] if is_one else sdf

    def mesh(self, shape: Shape, resolution: int = 256) -> Mesh:
        """The surface of a shape, in its source's frame or, where a code has none, the normalised one.

        Args:
            shape: which.
            resolution: points along an axis of the grid, >= 2.

        Returns:
            vertices [V, 3] float64 and faces [F, 3] int64; V = F = 0 where the field has no zero level.
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
        frame: Literal["shape", "normalised"] | Frame = "normalised",
        seed: int = 0,
    ) -> Tensor:
        """The code [L] of a shape that the space has not seen, by MAP estimation.

        Args:
            points: [N, 3]: all over the surface where `sdf` is not given.
            normals: [N, 3] outward normals of surface points.
            sdf: [N] signed distances at the points, negative inside, of both sides.
            frame: in which the points lie: normalised; a known one, such as `space.frames[id]`; or shape,
                where the bounding box of surface points tells it.
            seed: of the choice of points.

        Raises:
            SdfhubError: they do not tell a shape; says why.
        """
        if sdf is not None and normals is not None:
            raise SdfhubError("fit: normals belong to surface points; give them or sdf, not both")
        try:
            scan = Scan(_numbers(points), normals=_numbers(normals), sdf=_numbers(sdf))
            return self.fit_scan(scan, frame, seed)
        except (TypeError, ValueError, SdfhubError) as error:
            raise SdfhubError(f"fit: {error}") from error

    def fit_scan(
        self, scan: Scan, frame: Literal["shape", "normalised"] | Frame = "shape", seed: int = 0
    ) -> Tensor:
        """The code [L] of a scanned shape.

        Args:
            scan: from a file or from arrays.
            frame: as `fit` has it.
            seed: of the choice of points.

        Raises:
            SdfhubError: the scan does not fit the frame, or its mesh cannot be trusted.
        """
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
        distances = (self.codes - self._single_code(shape).detach()).norm(dim=1)
        if isinstance(shape, str | int | np.integer):
            distances[self.row(shape)] = torch.inf
        values, rows = distances.topk(min(k, len(self.ids)), largest=False)
        nearest = zip(rows.tolist(), values.tolist(), strict=True)
        return [(self.ids[row], value) for row, value in nearest if np.isfinite(value)]

    def unusual(self, shape: Shape | Sequence[Shape]) -> Tensor:
        """How far codes lie from the middle of the known ones, [] or [B]: about 1 for these.

        The squared distance over that of the known ones on average; some 5 to 10 for strangers.
        """
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

    def _tensor(self, array: Array) -> Tensor:
        try:
            return torch.as_tensor(_contiguous(array), dtype=torch.float32, device=self.device)
        except (TypeError, ValueError, RuntimeError) as error:
            raise SdfhubError(f"expected an array or tensor of numbers, got {array!r:.60}") from error


def _check_count(name: str, value: int, least: int) -> None:
    if not isinstance(value, int | np.integer) or value < least:
        raise SdfhubError(f"{name}={value!r}: must be a whole number, at least {least}")


def _numbers(array: Any) -> Any:
    return None if array is None else torch.as_tensor(_contiguous(array)).detach().cpu().double().numpy()


def _contiguous(array: Array) -> Array:
    """The same; a copy of a reversed numpy array, which torch does not take."""
    return np.ascontiguousarray(array) if isinstance(array, np.ndarray) and array.ndim else array


def reconstruct(decoder: Decoder, codes: Tensor, resolution: int) -> Iterator[Mesh]:
    """The zero levels of f(., z) of S codes, meshed together, one after another; empty without one.

    Args:
        decoder: in evaluation mode.
        codes: [S, L].
        resolution: points along an axis of the grid.

    Yields:
        vertices [V, 3], normalised frame, and faces [F, 3].
    """
    _check_count("resolution", resolution, 2)

    def fields(points: Tensor, shapes: Tensor) -> Tensor:
        return distances(decoder, points, codes[shapes])

    try:
        yield from mesh_fields(fields, len(codes), resolution, device=codes.device)
    except MemoryError as error:
        raise SdfhubError(f"resolution={resolution}: there is not enough memory for its grid") from error
