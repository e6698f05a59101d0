"""The decoder f_theta(x, z): an MLP from encoded points and a shape's code to a signed distance."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Annotated, Any

import torch
from pydantic import Field, PositiveInt
from torch import Tensor, nn
from torch.nn.utils.parametrizations import weight_norm as with_weight_norm

from sdfhub.described import Described
from sdfhub.model.activations import Activation, new_activation
from sdfhub.model.conditioning import Concat, Layer, full_precision
from sdfhub.model.dropout import dropout_factors
from sdfhub.model.encodings import as_encoding
from sdfhub.model.fast import waves

HEAD_SPREAD = 0.03  # of the initial output for hidden units of size 1: well inside the clamp delta = 0.1


def activated(
    activation: Activation,
    product: Tensor,
    shift: Tensor,
    dropout: float = 0.0,
    sloped: bool = False,
    beside: Tensor | None = None,
) -> tuple[Tensor, Tensor | None]:
    """[a(product + shift) | beside] and, where `sloped`, a'(product + shift), [B, N, W], with its dtype.

    The shift is float32, [W] or [B, 1, W]; what stands beside, [B, N, F], is what the next layer reads too; a
    unit that drops out has no slope either.
    """
    if not dropout and waves.fits(activation, product, shift):
        return waves.wave(activation, product, shift, sloped, beside)
    x = product + shift
    value, slope = activation.with_slope(x) if sloped else (activation(x), None)
    value, slope = value.to(product.dtype), None if slope is None else slope.to(product.dtype)
    if dropout:
        factors = dropout_factors(value, dropout)
        value, slope = value * factors, None if slope is None else slope * factors
    return value if beside is None else torch.cat([value, beside.to(value.dtype)], dim=-1), slope


class Decoder(Described, nn.Module):
    """Signed distances of B shapes at N points each.

    Source: Park et al. 2019, figure 4 and its published code (re-injection shortens the layer before, so
    that every layer reads `width` features); the paper re-injects its encoding into every layer.

    Args:
        encoding: maps points to F features: an `Encoding`, or any module with an attribute `features`.
        activation: makes one activation per hidden layer, called with `first=True` for the first where it
            takes that; what it makes is an `Activation` or any elementwise module.
        code_size: L.
        depth: number of hidden layers, >= 1.
        width: W, features that a hidden layer reads and emits.
        inject_encoding: layers (1 ... depth, `depth` is the output layer) that read the encoding again.
        inject_code: layers that read the code again.
        shorten: whether the layer before a re-injection emits that much less than `width`.
        weight_norm: whether hidden layers are split into direction and length.
        dropout: probability in [0, 1) of dropping a hidden unit while training.
        tanh: whether the output passes through tanh, as in DeepSDF's code.
        conditioning: class of the layers, or a partial of it: how a code enters them.
    """

    def __init__(
        self,
        encoding: nn.Module,
        activation: Callable[..., nn.Module],
        code_size: PositiveInt,
        depth: PositiveInt,
        width: PositiveInt,
        inject_encoding: Sequence[int] = (),
        inject_code: Sequence[int] = (),
        shorten: bool = True,
        weight_norm: bool = True,
        dropout: Annotated[float, Field(ge=0, lt=1)] = 0.0,
        tanh: bool = False,
        conditioning: type[Layer] | partial[Layer] = Concat,
    ):
        super().__init__()
        if not set(inject_encoding) | set(inject_code) <= set(range(1, depth + 1)):
            raise ValueError(f"inject_encoding and inject_code name layers 1 to {depth}")
        self.encoding, self.code_size = as_encoding(encoding), code_size
        self.dropout, self.tanh = dropout, tanh
        activations = [new_activation(activation, index == 0) for index in range(depth)]
        kind: Any = conditioning.func if isinstance(conditioning, partial) else conditioning
        layers: list[Layer] = []
        hidden, features = 0, self.encoding.features
        for index in range(depth + 1):
            after = features * (index + 1 in inject_encoding)
            after += code_size * (index + 1 in inject_code) * kind.joins_code
            outputs = 1 if index == depth else width - after * shorten
            if outputs < 1:
                hint = "widen it, encode with fewer features, or set shorten=false"
                raise ValueError(f"width {width} leaves no room for {after} re-injected features; {hint}")
            encoded = features if index == 0 or index in inject_encoding else 0
            code = code_size if index == 0 or index in inject_code else 0
            layers.append(conditioning(hidden, encoded, code, outputs))
            hidden = outputs
        self._initialize(layers, activations)
        if weight_norm:
            for layer in layers[:-1]:
                with_weight_norm(layer.linear)  # after the weights are drawn, so that their law is kept
        self.activations: Sequence[Activation] = nn.ModuleList(activations)  # type: ignore[assignment]
        self.layers: Sequence[Layer] = nn.ModuleList(layers)  # type: ignore[assignment]

    @staticmethod
    @torch.no_grad()
    def _initialize(layers: Sequence[Layer], activations: Sequence[Activation]) -> None:
        for layer, activation in zip(layers, activations, strict=False):
            bound = activation.weight_bound(layer.linear.in_features)
            layer.linear.weight.uniform_(-bound, bound)
            if (spread := activation.bias_bound()) is not None:
                layer.linear.bias.uniform_(-spread, spread)
        head = layers[-1].linear
        head.weight.normal_(0, HEAD_SPREAD / head.in_features**0.5)
        head.bias.zero_()

    def hidden_matrices(self) -> list[nn.Parameter]:
        """The weights of the layers between the first and the last; with weight norm their directions."""
        weights = [p for layer in self.layers[1:-1] for p in layer.linear.parameters() if p.ndim == 2]
        return [weight for weight in weights if weight.shape[1] > 1]  # lengths are a column

    def forward(self, points: Tensor, codes: Tensor) -> Tensor:
        """Signed distances [B, N] at points [B, N, 3], normalised frame, of shapes with codes [B, L]."""
        with full_precision(points):  # bfloat16 cannot tell points apart
            encoded = self.encoding(points)
        return self._field(encoded, codes)[0]

    def _field(self, encoded: Tensor, codes: Tensor, sloped=False) -> tuple[Tensor, list[Tensor | None]]:
        """Signed distances [B, N] and each hidden layer's slopes [B, N, W], where wanted, else None."""
        inputs, slopes, dropout = encoded, [], self.dropout if self.training else 0.0
        for layer, activation, following in zip(self.layers, self.activations, self.layers[1:], strict=False):
            product, shift = layer(inputs, codes)
            beside = encoded if following.columns[1] else None
            inputs, slope = activated(activation, product, shift, dropout, sloped, beside)
            slopes.append(slope)
        with full_precision(inputs):  # nor distances
            product, shift = self.layers[-1](inputs.to(encoded.dtype), codes)
        sdf = (product + shift).squeeze(-1)
        return torch.tanh(sdf) if self.tanh else sdf, slopes

    def value_and_gradient(self, points: Tensor, codes: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distances [B, N] and their spatial gradients [B, N, 3] at points [B, N, 3].

        The chain rule is written out as one more pass through the layers, so that a loss of the gradient
        is differentiated once, like any other, and the whole compiles.
        """
        with full_precision(points):
            encoded, to_space = self.encoding.with_pullback(points)
        sdf, slopes = self._field(encoded, codes, sloped=True)
        cotangent = (1 - sdf * sdf if self.tanh else torch.ones_like(sdf))[..., None]
        by_encoding = torch.zeros_like(encoded)
        for layer, slope in zip(reversed(self.layers), [*reversed(slopes), None], strict=True):
            by_hidden, part = layer.pullback(cotangent, codes)
            by_encoding = by_encoding if part is None else by_encoding + part
            if by_hidden is not None and slope is not None:
                cotangent = by_hidden * slope
        with full_precision(points):
            return sdf, to_space(by_encoding)
