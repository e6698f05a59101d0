"""The decoder f_theta(x, z): an MLP from encoded points and a shape's code to a signed distance."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.nn.utils.parametrizations import weight_norm as with_weight_norm

from sdfhub.model.activations import Activation
from sdfhub.model.encodings import Encoding

HEAD_SPREAD = 0.03
"""Standard deviation of the initial output for hidden units of size 1: well inside the clamp delta = 0.1."""


def full_precision(like: Tensor) -> AbstractContextManager:
    """Keeps autocast, where there is any on the device of `like`, off what is computed inside."""
    device = like.device.type
    # a region without need is one that torch.export must write down, and it cannot write one inside another
    return torch.autocast(device, enabled=False) if torch.is_autocast_enabled(device) else nullcontext()


class Layer(nn.Module):
    """A linear layer over [hidden | encoding | code] that never copies the code once per point.

    The code's columns act once per shape; their result, with the bias, is broadcast over its points.

    Args:
        hidden, encoding, code: number of input columns of each part; 0 leaves the part out.
        outputs: number of output features.

    Attributes:
        joins_code: whether a code is among a layer's inputs, beside the hidden features.
    """

    joins_code = True

    def __init__(self, hidden: int, encoding: int, code: int, outputs: int):
        super().__init__()
        self.columns = [hidden, encoding, code]
        self.linear = nn.Linear(sum(self.columns), outputs)

    def forward(self, inputs: Tensor, codes: Tensor) -> tuple[Tensor, Tensor]:
        """Product [B, N, outputs] and the shift [B, 1, outputs] or [outputs] that is to be added to it.

        Args:
            inputs: [B, N, H + F], hidden features and encoded points.
            codes: [B, L].
        """
        from_points, from_code = self.linear.weight.split([sum(self.columns[:2]), self.columns[2]], dim=1)
        shift = self.linear.bias
        if self.columns[2]:
            with full_precision(codes):  # one error here moves a whole shape
                shift = F.linear(codes, from_code, self.linear.bias)[:, None]
        if self.columns[0]:
            return F.linear(inputs, from_points), shift
        with full_precision(inputs):  # a place deserves all its digits too
            return F.linear(inputs, from_points), shift

    def pullback(self, cotangent: Tensor, codes: Tensor) -> tuple[Tensor | None, Tensor | None]:
        """Cotangents of hidden [B, N, H] and encoding [B, N, F], None where not read, from the output's.

        Args:
            codes: [B, L], for layers that are scaled by them; this one is not.
        """
        parts = self.linear.weight.split(self.columns, dim=1)[:2]
        return tuple(cotangent @ part if part.shape[1] else None for part in parts)


class Decoder(nn.Module):
    """Signed distances of B shapes at N points each.

    Source: Park et al. 2019, figure 4 and its published code (re-injection shortens the layer before, so
    that every layer reads `width` features); the paper re-injects its encoding into every layer.

    Args:
        encoding: maps points to F features.
        activation: makes one activation per hidden layer, called with `first=True` for the first.
        code_size: L.
        depth: number of hidden layers, >= 1.
        width: W, features that a hidden layer reads and emits.
        inject_encoding: layers (1 ... depth, `depth` is the output layer) that read the encoding again.
        inject_code: layers that read the code again.
        shorten: whether the layer before a re-injection emits that much less than `width`.
        weight_norm: whether hidden layers are split into direction and length.
        dropout: probability in [0, 1) of dropping a hidden unit while training.
        tanh: whether the output passes through tanh, as in DeepSDF's code.
        conditioning: class of the layers, which decides how a code enters them.
    """

    def __init__(
        self,
        encoding: Encoding,
        activation: Callable[..., Activation],
        code_size: int,
        depth: int,
        width: int,
        inject_encoding: Sequence[int] = (),
        inject_code: Sequence[int] = (),
        shorten: bool = True,
        weight_norm: bool = True,
        dropout: float = 0.0,
        tanh: bool = False,
        conditioning: type[Layer] = Layer,
    ):
        super().__init__()
        if min(depth, width, code_size) < 1 or not 0 <= dropout < 1:
            raise ValueError(
                "depth, width and code_size must be at least 1, dropout in [0, 1); "
                f"got {depth}, {width}, {code_size}, {dropout}"
            )
        if not set(inject_encoding) | set(inject_code) <= set(range(1, depth + 1)):
            raise ValueError(f"inject_encoding and inject_code name layers 1 to {depth}")
        self.encoding, self.code_size = encoding, code_size
        self.dropout, self.tanh = dropout, tanh
        self.activations = nn.ModuleList(activation(first=index == 0) for index in range(depth))
        self.layers = nn.ModuleList()
        hidden = 0
        for index in range(depth + 1):
            encoded = encoding.features if index == 0 or index in inject_encoding else 0
            code = code_size if index == 0 or index in inject_code else 0
            after = encoding.features * (index + 1 in inject_encoding)
            after += code_size * (index + 1 in inject_code) * conditioning.joins_code
            outputs = 1 if index == depth else width - after * shorten
            if outputs < 1:
                raise ValueError(
                    f"width {width} leaves no room for {after} re-injected features; "
                    "widen it, encode with fewer features, or set shorten=false"
                )
            self.layers.append(conditioning(hidden, encoded, code, outputs))
            hidden = outputs
        self._initialize()
        if weight_norm:
            for layer in self.layers[:-1]:
                with_weight_norm(layer.linear)  # after the weights are drawn, so that their law is kept

    @torch.no_grad()
    def _initialize(self) -> None:
        for layer, activation in zip(self.layers, self.activations, strict=False):
            bound = activation.weight_bound(layer.linear.in_features)
            layer.linear.weight.uniform_(-bound, bound)
            if (bound := activation.bias_bound()) is not None:
                layer.linear.bias.uniform_(-bound, bound)
        head = self.layers[-1].linear
        head.weight.normal_(0, HEAD_SPREAD / head.in_features**0.5)
        head.bias.zero_()

    def forward(self, points: Tensor, codes: Tensor) -> Tensor:
        """Signed distances [B, N] at points [B, N, 3], normalised frame, of shapes with codes [B, L]."""
        with full_precision(points):  # a place deserves all its digits
            encoded = self.encoding(points)
        inputs, dropout = encoded, self.dropout if self.training else 0.0
        for layer, activation, following in zip(self.layers, self.activations, self.layers[1:], strict=False):
            product, shift = layer(inputs, codes)
            beside = encoded if following.columns[1] else None
            inputs = activation.shifted(product, shift, beside, dropout)
        return self._head(inputs, encoded, codes)

    def _head(self, inputs: Tensor, encoded: Tensor, codes: Tensor) -> Tensor:
        with full_precision(inputs):  # a distance deserves all its digits
            product, shift = self.layers[-1](inputs.to(encoded.dtype), codes)
        sdf = (product + shift).squeeze(-1)
        return torch.tanh(sdf) if self.tanh else sdf

    def value_and_gradient(self, points: Tensor, codes: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distances [B, N] and their spatial gradients [B, N, 3] at points [B, N, 3].

        The chain rule is written out as one more pass through the layers, so that a loss of the gradient
        is differentiated once, like any other, and the whole compiles.

        Args:
            points: normalised frame.
            codes: [B, L].
        """
        with full_precision(points):
            encoded, to_space = self.encoding.with_pullback(points)
        inputs, slopes, dropout = encoded, [], self.dropout if self.training else 0.0
        for layer, activation, following in zip(self.layers, self.activations, self.layers[1:], strict=False):
            product, shift = layer(inputs, codes)
            beside = encoded if following.columns[1] else None
            inputs, slope = activation.shifted_with_slope(product, shift, beside, dropout)
            slopes.append(slope)
        sdf = self._head(inputs, encoded, codes)
        cotangent = torch.ones_like(sdf)[..., None]
        if self.tanh:
            cotangent = (1 - sdf * sdf)[..., None]
        by_encoding = torch.zeros_like(encoded)
        for layer, slope in zip(reversed(self.layers), [*reversed(slopes), None], strict=True):
            by_hidden, part = layer.pullback(cotangent, codes)
            by_encoding = by_encoding if part is None else by_encoding + part
            cotangent = None if slope is None else by_hidden * slope
        with full_precision(points):
            return sdf, to_space(by_encoding)
