"""How a code enters the decoder's layers; rivals share one signature.

A layer is affine in its inputs: product + shift, where the product is linear in [hidden | encoding]. A rival
needs `forward` alone; `pullback` is autograd's by default.
"""

from abc import ABC, abstractmethod
from contextlib import AbstractContextManager, nullcontext

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from sdfhub.described import Described
from sdfhub.model.derivatives import value_and_pullback

# of hidden [B, N, H] and of encoding [B, N, F]; None for a part that a layer does not read
Cotangents = tuple[Tensor | None, Tensor | None]


def full_precision(like: Tensor) -> AbstractContextManager:
    """Keeps autocast, if any on the device of `like`, off what is computed inside."""
    device = like.device.type
    # torch.export must write down every region, and cannot write one inside another
    return torch.autocast(device, enabled=False) if torch.is_autocast_enabled(device) else nullcontext()


class Layer(Described, nn.Module, ABC):
    """A linear layer over [hidden | encoding], steered by a code; it holds the weights of `linear`.

    Args:
        hidden, encoding, code: columns H, F and L of each part; 0 leaves the part out.
        outputs: W, number of output features.
    """

    joins_code = False
    """Whether codes are columns of `linear`, for which a layer before makes room where it is shortened."""

    def __init__(self, hidden: int, encoding: int, code: int, outputs: int):
        super().__init__()
        self.columns = [hidden, encoding, code if self.joins_code else 0]
        self.linear = nn.Linear(sum(self.columns), outputs)

    @abstractmethod
    def forward(self, inputs: Tensor, codes: Tensor) -> tuple[Tensor, Tensor]:
        """Product [B, N, W], linear in the inputs [B, N, H + F], and the shift by codes [B, L] added to it.

        The shift is [B, 1, W] or [W].
        """

    def pullback(self, cotangent: Tensor, codes: Tensor) -> Cotangents:
        """Cotangents of hidden and encoding from the output's [B, N, W], with codes [B, L]."""
        hidden, encoding, _ = self.columns
        anywhere = cotangent.new_zeros(*cotangent.shape[:-1], hidden + encoding)  # the Jacobian is constant
        pulled = value_and_pullback(lambda inputs: self(inputs, codes)[0], anywhere)[1](cotangent)
        return pulled[..., :hidden] if hidden else None, pulled[..., hidden:] if encoding else None


class Concat(Layer):
    """The code is an input beside the point: W [hidden | encoding | code] + b.

    The code's columns act once per shape; their result, with the bias, is broadcast over its points.

    Source: Park et al. 2019, figure 4.
    """

    joins_code = True

    def forward(self, inputs: Tensor, codes: Tensor) -> tuple[Tensor, Tensor]:
        hidden, encoding, code = self.columns
        from_points, from_code = self.linear.weight.split([hidden + encoding, code], dim=1)
        shift: Tensor = self.linear.bias
        if code:
            with full_precision(codes):  # one error here moves a whole shape
                shift = F.linear(codes, from_code, self.linear.bias)[:, None]
        with nullcontext() if hidden else full_precision(inputs):  # bfloat16 cannot tell points apart
            return F.linear(inputs, from_points), shift

    def pullback(self, cotangent: Tensor, codes: Tensor) -> Cotangents:
        by_hidden, by_encoding, _ = self.linear.weight.split(self.columns, dim=1)
        hidden, encoding, _ = self.columns
        return cotangent @ by_hidden if hidden else None, cotangent @ by_encoding if encoding else None


class Film(Concat):
    """The code scales and shifts a layer's output: (1 + s(z)) (W x + b) + t(z).

    s and t are one linear map of the code, a layer's own, without pi-GAN's mapping network before it.

    Source: Perez et al. 2018 (FiLM); Chan et al. 2021 (pi-GAN) for sines.
    """

    joins_code = False
    pullback = Layer.pullback

    def __init__(self, hidden: int, encoding: int, code: int, outputs: int):
        super().__init__(hidden, encoding, code, outputs)
        self.film = nn.Linear(code, 2 * outputs) if code else None

    def forward(self, inputs: Tensor, codes: Tensor) -> tuple[Tensor, Tensor]:
        product, bias = super().forward(inputs, codes)
        if self.film is None:
            return product, bias
        with full_precision(codes):  # one error here moves a whole shape
            scale, shift = self.film(codes)[:, None].chunk(2, dim=-1)
        return (product * (1 + scale)).to(product.dtype), (1 + scale) * bias + shift
