"""How one mesh becomes signed samples: plain numbers, filled from YAML and hashed by the store."""

from collections.abc import Callable
from typing import Annotated, Literal

from pydantic import Field, NonNegativeInt, PositiveFloat, PositiveInt
from pydantic.dataclasses import dataclass


@dataclass(frozen=True)
class Preparation:
    """Number, places and sign method of the samples, and the limits of a mesh.

    Source: DeepSDF (Park et al. 2019), section 5 and its published code, whose jitter variances are twice
    those of its paper; `min_*` and `max_*` are the limits beyond which `prepare_mesh` raises `RejectedMesh`.
    """

    # a method's name (winding takes pseudo_normal on clean closed meshes), or one's own `signs.SignMethod`
    sign: Literal["winding", "vote", "pseudo_normal"] | Callable = "winding"
    samples: PositiveInt = 500_000  # of a shape, signed
    near_share: Annotated[float, Field(ge=0, le=1)] = 0.94  # near the surface; the rest in [-1, 1]^3
    # of the near ones: mirrored in x, y or z, with their own distances, where a field may mistake sides
    decoy_share: Annotated[float, Field(ge=0, le=1)] = 0.0
    variances: Annotated[tuple[PositiveFloat, ...], Field(min_length=1)] = (0.005, 0.0005)  # of the jitter
    surface_points: NonNegativeInt = 30_000  # of a shape, oriented
    views: Annotated[int, Field(ge=8)] = 100  # directions from which faces are looked at
    hidden_below: float = 0.04  # a face seen less than this share of what it would be alone is dropped
    two_sided_above: float = 0.25  # share of its sightings on the less seen side that makes a face a sheet
    drop_uncertain: bool = False  # leave out samples of uncertain sign (DeepSDF: a unanimous vote or none)
    min_faces: NonNegativeInt = 50
    min_extent_ratio: float = 0.01  # smallest side of the bounding box over its largest
    max_zero_area: float = 0.3  # share of the triangles
    max_components: PositiveInt = 2000  # connected pieces
    max_two_sided_area: float = 0.25  # share of the visible area
    min_certain: float = 0.9  # share of the samples whose sign is certain (winding: |w - 0.5| > 0.25)
    min_inside: float = 0.005  # share of the samples
    max_inside: float = 0.75
    max_contradictory: float = 0.02  # share of sightings on the less seen side of their face (sign=vote)
    max_bad_faces: float = 0.03  # share of the visible area with over a tenth of them there (sign=vote)


DEFAULT = Preparation()  # the paper's pipeline, with the winding number for the sign
