"""Nonlinearities that are local: a bump, and a wave under a bump. They fall to zero on both sides."""

import math

import torch
from torch import Tensor

from sdfhub.model.activations import Activation


class Gauss(Activation):
    """exp(-x^2 / (2 a^2)), initialised as PyTorch's linear layers are.

    Source: Ramasinghe and Lucey 2022, table 1; they draw weights by several laws and find that it matters
    little for this activation.

    Args:
        a: width of the bump, > 0; a narrow one gives features of higher rank and a steeper field.
        first: whether it follows the layer that reads the encoded points.
    """

    def __init__(self, a: float, first: bool = False):
        super().__init__(first)
        if a <= 0:
            raise ValueError(f"a must be positive, got {a}")
        self.a = a

    def weight_bound(self, fan_in: int) -> float:
        return 1 / math.sqrt(fan_in)

    def forward(self, x: Tensor) -> Tensor:
        return torch.exp(-0.5 * (x / self.a).square())

    def with_slope(self, x: Tensor) -> tuple[Tensor, Tensor]:
        bump = self(x)
        return bump, -x / self.a**2 * bump


class Wire(Activation):
    """cos(omega x) exp(-(s x)^2), initialised as PyTorch's linear layers are.

    The real part of the complex Gabor wavelet exp(i omega x) exp(-|s x|^2), which would need complex weights.
    The real layer in the authors' code has weights of its own for the bump; here wave and bump share one
    linear map, as they do in the complex layer.

    Source: Saragadam et al. 2023, equation 5 (WIRE), and its published code.

    Args:
        omega_0: frequency of the first layer's wave, > 0.
        omega_hidden: frequency of the wave in every other layer, > 0.
        s: inverse width of the bump, > 0.
        first: whether it follows the layer that reads the encoded points.
    """

    def __init__(self, omega_0: float, omega_hidden: float, s: float, first: bool = False):
        super().__init__(first)
        self.omega, self.s = omega_0 if first else omega_hidden, s
        if min(self.omega, s) <= 0:
            raise ValueError(f"omega_0, omega_hidden and s must be positive, got {self.omega} and {s}")

    def weight_bound(self, fan_in: int) -> float:
        return 1 / math.sqrt(fan_in)

    def forward(self, x: Tensor) -> Tensor:
        return torch.cos(self.omega * x) * torch.exp(-(self.s * x).square())

    def with_slope(self, x: Tensor) -> tuple[Tensor, Tensor]:
        angle, bump = self.omega * x, torch.exp(-(self.s * x).square())
        wave = torch.cos(angle) * bump
        return wave, -self.omega * torch.sin(angle) * bump - 2 * self.s**2 * x * wave

    def monitored(self) -> dict[str, float]:
        return {"omega": self.omega}
