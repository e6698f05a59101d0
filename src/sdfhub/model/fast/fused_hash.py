"""The hash encoding by tiny-cuda-nn, where that is installed: one kernel a level and direction, on a GPU.

It reads the table of `Hash`: a checkpoint does not know which of them trained it. Each level is a grid of its
own, because tiny-cuda-nn ties the resolutions of a grid's levels.

Source: https://github.com/NVlabs/tiny-cuda-nn, `GridEncoding`. Compared with `Hash` it reads places in [0, 1]
and half a cell further, counts vertices where we count cells, lets the first axis of a directly indexed grid
vary fastest, and holds a multiple of eight rows.
"""

import warnings
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from typing import TypeGuard

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.func import functional_call

from sdfhub.model.encodings import Encoding, Hash

WIDTHS = (1, 2, 4, 8)  # features a level that tiny-cuda-nn has kernels for
PROBES, TOLERANCE = 4096, 1e-3  # points at which a twin must agree, and how far it may differ, relatively


class FusedHash(Encoding):
    """The same features as those of the encoding `plain`, from the same table."""

    def __init__(self, plain: Hash):
        super().__init__()
        self.features, self.table = plain.features, plain.table
        config = {"otype": "Grid", "type": "Hash", "interpolation": "Smoothstep", "n_levels": 1}
        config |= {"n_features_per_level": plain.width, "per_level_scale": 1.0}
        config |= {"log2_hashmap_size": (max(plain.rows) - 1).bit_length()}
        make = partial(import_module("tinycudann").Encoding, 3, dtype=torch.float32)
        # in lists, so that neither the grids' own tables nor the twin's become weights of this module
        self._plain, self._cells = [plain], [int(cells) for cells in plain.cells]
        self._grids = [make(config | {"base_resolution": cells + 1}) for cells in self._cells]

    def plain(self) -> Hash:
        return self._plain[0]

    @torch.compiler.disable
    def forward(self, points: Tensor) -> Tensor:
        plain, places = self._plain[0], (points.flatten(0, -2) + 1) / 2
        tables = self.table.split(plain.rows)
        features = [points.flatten(0, -2)] if plain.include_points else []
        for level, (grid, cells, rows) in enumerate(zip(self._grids, self._cells, tables, strict=True)):
            # a hash knows no border; a grid that is indexed directly goes on with its last value
            indexed = level < plain.dense
            inside = places.clamp(0, 1).flip(-1) if indexed else places
            padded = F.pad(rows.flatten(), (0, -len(rows) % 8 * plain.width * indexed))
            features.append(functional_call(grid, {"params": padded}, (inside - 0.5 / cells,)))
        return torch.cat(features, dim=-1).unflatten(0, points.shape[:-1])


def can_fuse(encoding: Encoding, device: torch.device) -> TypeGuard[Hash]:
    """Whether there could be a twin on this device."""
    fits = isinstance(encoding, Hash) and encoding.width in WIDTHS and device.type == "cuda"
    return fits and find_spec("tinycudann") is not None


def fused(plain: Hash) -> Encoding:
    """The twin of a hash encoding, or the encoding itself where the library fails or disagrees."""
    try:
        twin = FusedHash(plain)
        difference = disagreement(twin, plain)
        if difference <= TOLERANCE:
            return twin
        reason = f"its grid differs by {difference:.1e}"
    except Exception as error:  # whatever a library made for another GPU raises
        reason = f"{type(error).__name__}: {str(error).strip().partition(chr(10))[0]}"
    warnings.warn(f"tinycudann: goes on without, {reason}", stacklevel=2)
    return plain


def disagreement(twin: Encoding, plain: Hash) -> float:
    """Largest relative difference of features, their slopes, and the table's gradient through both."""
    generator = torch.Generator().manual_seed(0)
    points = (torch.rand(1, PROBES, 3, generator=generator) * 2.2 - 1.1).to(plain.table)
    cotangent = torch.randn(1, PROBES, plain.features, generator=generator).to(plain.table)
    cotangent[..., : 3 * plain.include_points] = 0  # the coordinates themselves would hide the table
    results = []
    for encoding in (twin, plain):
        with torch.enable_grad():
            features, pullback = encoding.with_pullback(points)
            slopes = pullback(cotangent)
            learned = (features * cotangent).sum() + slopes.square().sum() / slopes.detach().norm()
            by_table = torch.autograd.grad(learned, plain.table)[0]
        results.append([(features * cotangent).detach(), slopes.detach(), by_table])
    ratios = [(have - want).norm() / want.norm() for have, want in zip(*results, strict=True)]
    return float(torch.stack(ratios).nan_to_num(torch.inf).max())
