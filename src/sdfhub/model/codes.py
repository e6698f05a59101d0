"""The table of latent codes: one row z per training shape."""

import math

import torch
from pydantic import PositiveFloat, PositiveInt
from torch import Tensor, nn

from sdfhub.described import Described


class CodeTable(Described, nn.Module):
    """Learned codes, started at N(0, 1 / L), so that their expected norm is 1.

    Source: Park et al. 2019, section 4.2; `max_norm` as in its published code.
    Codes [shapes, size] longer than `max_norm` are shortened to it when they are read.
    """

    def __init__(self, shapes: PositiveInt, size: PositiveInt, max_norm: PositiveFloat | None = None):
        super().__init__()
        self.max_norm = max_norm
        self.table = nn.Parameter(torch.randn(shapes, size) / math.sqrt(size))

    def forward(self, rows: Tensor) -> Tensor:
        """Codes [B, L] of table rows [B]."""
        self.shorten()
        return self.table[rows]

    @torch.no_grad()
    def shorten(self) -> None:
        """Shortens the codes that are too long."""
        if self.max_norm is not None:  # all rows: processes that read different ones must keep equal tables
            self.table.renorm_(2, 0, self.max_norm)
