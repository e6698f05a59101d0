"""How one mesh becomes signed samples: plain numbers, filled from YAML and hashed by the store."""

from typing import Annotated, Literal

from pydantic import Field, NonNegativeInt, PositiveFloat, PositiveInt
from pydantic.dataclasses import dataclass


@dataclass(frozen=True)
class Preparation:
    """Number, places and sign method of the samples, and the limits of a mesh.

    Source: DeepSDF (Park et al. 2019), section 5 and its published code, whose jitter variances are twice
    those of its paper; `min_*` and `max_*` are the limits beyond which `prepare_mesh` raises `RejectedMesh`.

    Args:
        sign: how inside is told from outside. "winding" takes the pseudo-normal on clean closed meshes.
        samples: signed samples of a shape.
        near_share: share of them near the surface, split evenly over `variances`; the rest is uniform in
            [-1, 1]^3.
        variances: squared standard deviations of the jitter, normalised units squared.
        surface_points: oriented surface samples of a shape.
        views: directions, spread over the sphere, from which faces are looked at.
        hidden_below: a face is dropped if it is seen less than this share of what it would be in isolation.
        two_sided_above: a face is a two-sided sheet if its less seen side has more than this share of its
            sightings.
        drop_uncertain: leave out samples whose sign is uncertain (DeepSDF's rule: a unanimous vote or none).
        min_faces: triangles in the source.
        min_extent_ratio: smallest side of the bounding box over its largest.
        max_zero_area: share of the triangles without an area.
        max_components: connected pieces.
        max_two_sided_area: share of the visible area that belongs to two-sided sheets.
        min_certain: share of the samples whose sign is certain (winding: |w - 0.5| > 0.25).
        min_inside, max_inside: share of the samples that lie inside.
        max_contradictory: share of sightings on the less seen side of their face (sign=vote only).
        max_bad_faces: share of the visible area with over a tenth of its sightings there (sign=vote only).
    """

    sign: Literal["winding", "vote", "pseudo_normal"] = "winding"
    samples: PositiveInt = 500_000
    near_share: Annotated[float, Field(ge=0, le=1)] = 0.94
    variances: Annotated[tuple[PositiveFloat, ...], Field(min_length=1)] = (0.005, 0.0005)
    surface_points: NonNegativeInt = 30_000
    views: Annotated[int, Field(ge=8)] = 100
    hidden_below: float = 0.04
    two_sided_above: float = 0.25
    drop_uncertain: bool = False
    min_faces: NonNegativeInt = 50
    min_extent_ratio: float = 0.01
    max_zero_area: float = 0.3
    max_components: PositiveInt = 2000
    max_two_sided_area: float = 0.25
    min_certain: float = 0.9
    min_inside: float = 0.005
    max_inside: float = 0.75
    max_contradictory: float = 0.02
    max_bad_faces: float = 0.03


DEFAULT = Preparation()
"""The paper's pipeline, with the winding number for the sign."""
