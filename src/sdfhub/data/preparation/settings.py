"""How one mesh becomes signed samples: plain numbers, filled from YAML and hashed by the store."""

from dataclasses import dataclass
from typing import Literal

from sdfhub.errors import SdfhubError


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
        min_inside: share of the samples that lie inside.
        max_inside: share of the samples that lie inside.
        max_contradictory: share of sightings on the less seen side of their face (sign=vote only).
        max_bad_faces: share of the visible area with over a tenth of its sightings there (sign=vote only).
    """

    sign: Literal["winding", "vote", "pseudo_normal"] = "winding"
    samples: int = 500_000
    near_share: float = 0.94
    variances: tuple[float, ...] = (0.005, 0.0005)
    surface_points: int = 30_000
    views: int = 100
    hidden_below: float = 0.04
    two_sided_above: float = 0.25
    drop_uncertain: bool = False
    min_faces: int = 50
    min_extent_ratio: float = 0.01
    max_zero_area: float = 0.3
    max_components: int = 2000
    max_two_sided_area: float = 0.25
    min_certain: float = 0.9
    min_inside: float = 0.005
    max_inside: float = 0.75
    max_contradictory: float = 0.02
    max_bad_faces: float = 0.03

    def __post_init__(self):
        object.__setattr__(self, "variances", tuple(self.variances))  # YAML gives a list
        methods = "winding", "vote", "pseudo_normal"
        for name, valid, wanted in (
            ("sign", self.sign in methods, f"one of {', '.join(methods)}"),
            ("samples", self.samples >= 1, "at least 1"),
            ("near_share", 0 <= self.near_share <= 1, "within [0, 1]"),
            ("variances", len(self.variances) > 0 and min(self.variances) > 0, "positive numbers"),
            ("surface_points", self.surface_points >= 0, "at least 0"),
            ("views", self.views >= 8, "at least 8"),
            ("min_faces", self.min_faces >= 0, "at least 0"),
            ("max_components", self.max_components >= 1, "at least 1"),
        ):
            if not valid:
                raise SdfhubError(f"preparation.{name}={getattr(self, name)}: must be {wanted}")


DEFAULT = Preparation()
"""The paper's pipeline, with the winding number for the sign."""
