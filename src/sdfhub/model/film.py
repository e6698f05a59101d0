"""Conditioning by scale and shift: the code enters no layer, it steers what the layer makes of a point."""

from torch import Tensor, nn

from sdfhub.model.decoder import Layer, full_precision


class Film(Layer):
    """A linear layer whose code scales and shifts its output: (1 + s(z)) (W x + b) + t(z).

    s and t are one linear map of the code, a layer's own; pi-GAN has a mapping network before it, which a
    table of free codes needs less than a generator's noise does.

    Source: Perez et al. 2018 (FiLM); Chan et al. 2021 (pi-GAN) for sines.

    Args:
        hidden, encoding: number of input columns of each part; 0 leaves the part out.
        code: L, numbers in the code; 0 leaves the layer unconditioned.
        outputs: W, number of output features.
    """

    joins_code = False

    def __init__(self, hidden: int, encoding: int, code: int, outputs: int):
        super().__init__(hidden, encoding, 0, outputs)
        self.film = nn.Linear(code, 2 * outputs) if code else None

    def forward(self, inputs: Tensor, codes: Tensor) -> tuple[Tensor, Tensor]:
        """Product [B, N, W] and the shift [B, 1, W] or [W] that is to be added to it, as in `Layer`."""
        product, bias = super().forward(inputs, codes)
        if self.film is None:
            return product, bias
        scale, shift = self._scale_and_shift(codes)
        return (product * scale).to(product.dtype), scale * bias + shift

    def pullback(self, cotangent: Tensor, codes: Tensor) -> tuple[Tensor | None, Tensor | None]:
        """Cotangents of hidden and encoding, as in `Layer`."""
        if self.film is not None:
            cotangent = cotangent * self._scale_and_shift(codes)[0]
        return super().pullback(cotangent, codes)

    def _scale_and_shift(self, codes: Tensor) -> tuple[Tensor, Tensor]:
        with full_precision(codes):  # one error here moves a whole shape
            scale, shift = self.film(codes)[:, None].chunk(2, dim=-1)
            return 1 + scale, shift
