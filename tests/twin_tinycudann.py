"""What tiny-cuda-nn's grid encoding computes, vertex by vertex, for machines without a GPU.

Written from its description (`GridEncoding` of https://github.com/NVlabs/tiny-cuda-nn), not from our
encoding: numbers of 32 bits, a table of its own size for every level, and the offset of half a cell.
"""

from itertools import product

import torch
from torch import Tensor, nn

PRIMES = (1, 2_654_435_761, 805_459_861)


class Encoding(nn.Module):
    """`tinycudann.Encoding` for `otype: Grid`, `type: Hash`, smooth interpolation and three coordinates."""

    def __init__(self, n_input_dims: int, encoding_config: dict, seed: int = 1337, dtype=None):
        super().__init__()
        assert n_input_dims == 3 and dtype == torch.float32
        assert encoding_config["otype"] == "Grid" and encoding_config["type"] == "Hash"
        assert encoding_config["interpolation"] == "Smoothstep"
        self.width = encoding_config["n_features_per_level"]
        assert self.width in (1, 2, 4, 8)
        self.levels = []
        for level in range(encoding_config["n_levels"]):
            grown = encoding_config["base_resolution"] * encoding_config["per_level_scale"] ** level
            vertices = -int(-(grown - 1) // 1) + 1
            rows = min(-(-(vertices**3) // 8) * 8, 2 ** encoding_config["log2_hashmap_size"])
            self.levels.append((grown - 1, vertices, rows))
        self.params = nn.Parameter(torch.empty(sum(rows for *_, rows in self.levels) * self.width))
        nn.init.uniform_(self.params, -1e-4, 1e-4)

    def forward(self, x: Tensor) -> Tensor:
        assert x.dim() == 2 and len(self.params) == sum(rows for *_, rows in self.levels) * self.width
        first, features = 0, []
        for scale, vertices, rows in self.levels:
            table = self.params[first : first + rows * self.width].unflatten(0, (rows, self.width))
            features.append(self._level(x * scale + 0.5, vertices, table))
            first += rows * self.width
        return torch.cat(features, dim=1)

    def _level(self, place: Tensor, vertices: int, table: Tensor) -> Tensor:
        low = place.detach().floor()
        share = place - low
        smooth = share * share * (3 - 2 * share)
        result = 0.0
        for corner in product((0, 1), repeat=3):
            weight = 1.0
            for axis, high in enumerate(corner):
                weight = weight * (smooth[:, axis] if high else 1 - smooth[:, axis])
            vertex = (low.long() + torch.tensor(corner)) % 2**32
            result = result + weight[:, None] * table[self._row(vertex, vertices, len(table))]
        return result

    @staticmethod
    def _row(vertex: Tensor, vertices: int, rows: int) -> Tensor:
        if vertices**3 <= rows:
            index = vertex[:, 0] + vertex[:, 1] * vertices + vertex[:, 2] * vertices**2
        else:
            x, y, z = (vertex[:, axis] * prime % 2**32 for axis, prime in enumerate(PRIMES))
            index = x ^ y ^ z
        return index % 2**32 % rows
