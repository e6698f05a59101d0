"""Nonlinearities of the decoder, one instance per hidden layer.

Each rival is a module with three duties: `forward`; `with_slope`, the same beside its derivative, from which
the decoder computes spatial gradients; and `weight_bound`, the half-width of the uniform distribution from
which the weights of the linear layer before it are drawn. `shifted` is where a rival may be faster than its
plain formula: it adds the code's share of the layer's output and applies the activation.
"""

import math
from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn

from sdfhub.model.fast.dropout import kept
from sdfhub.model.fast.loops import fits
from sdfhub.model.fast.rectifier import Rectifier
from sdfhub.model.fast.waves import Wave


def joined(hidden: Tensor, beside: Tensor | None) -> Tensor:
    """[hidden | beside], [B, N, W + F] with the dtype of `hidden`, which alone is returned for None."""
    return hidden if beside is None else torch.cat([hidden, beside.to(hidden.dtype)], dim=-1)


class Activation(nn.Module, ABC):
    """An elementwise nonlinearity that knows how the layer before it must be initialised.

    Args:
        first: whether it follows the layer that reads the encoded points.
    """

    def __init__(self, first: bool = False):
        super().__init__()
        self.first = first

    @abstractmethod
    def with_slope(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """a(x) and a'(x), both shaped like x and both differentiable."""

    def shifted(
        self, product: Tensor, shift: Tensor, beside: Tensor | None = None, dropout: float = 0.0
    ) -> Tensor:
        """[a(product + shift) | beside], [B, N, W + F] with the dtype of `product`.

        Args:
            product: [B, N, W].
            shift: [W] or [B, 1, W] float32.
            beside: [B, N, F], what the next layer reads beside this one; None for nothing, F = 0.
            dropout: probability in [0, 1) that a hidden unit is 0; the others are divided by 1 - dropout.
        """
        value = self(product + shift).to(product.dtype)
        return joined(value * kept(value, dropout) if dropout else value, beside)

    def shifted_with_slope(
        self, product: Tensor, shift: Tensor, beside: Tensor | None = None, dropout: float = 0.0
    ) -> tuple[Tensor, Tensor]:
        """As `shifted`, and a'(product + shift) [B, N, W], dropped alike."""
        value, slope = (each.to(product.dtype) for each in self.with_slope(product + shift))
        if dropout:
            factors = kept(value, dropout)
            value, slope = value * factors, slope * factors
        return joined(value, beside), slope

    @abstractmethod
    def weight_bound(self, fan_in: int) -> float:
        """Half-width b of U(-b, b), the initial weights of the layer before, for `fan_in` inputs."""

    def bias_bound(self) -> float | None:
        """Half-width of the initial biases before it; None keeps PyTorch's, U(+-1/sqrt(fan_in))."""
        return None

    def monitored(self) -> dict[str, float]:
        """Numbers worth a curve while training, by name; none by default."""
        return {}


class Relu(Activation):
    """max(0, x), initialised as PyTorch's linear layers are (DeepSDF's choice)."""

    def weight_bound(self, fan_in: int) -> float:
        return 1 / math.sqrt(fan_in)

    def forward(self, x: Tensor) -> Tensor:
        return torch.relu(x)

    def with_slope(self, x: Tensor) -> tuple[Tensor, Tensor]:
        return torch.relu(x), (x > 0).to(x.dtype)

    def shifted(
        self, product: Tensor, shift: Tensor, beside: Tensor | None = None, dropout: float = 0.0
    ) -> Tensor:
        if not fits(product):
            return super().shifted(product, shift, beside, dropout)
        return Rectifier.apply(product, shift, beside, dropout, False)

    def shifted_with_slope(
        self, product: Tensor, shift: Tensor, beside: Tensor | None = None, dropout: float = 0.0
    ) -> tuple[Tensor, Tensor]:
        if not fits(product):
            return super().shifted_with_slope(product, shift, beside, dropout)
        return Rectifier.apply(product, shift, beside, dropout, True)


class Siren(Activation):
    """sin(omega x), with one omega for the first layer and one for the others.

    Source: Sitzmann et al. 2020, section 3.2: first layer U(-1/n, 1/n), others U(+-sqrt(6/n) / omega).

    Args:
        omega_0: frequency factor of the first layer, > 0.
        omega_hidden: frequency factor of every other layer, > 0.
        first: whether it follows the layer that reads the encoded points.
    """

    def __init__(self, omega_0: float, omega_hidden: float, first: bool = False):
        super().__init__(first)
        self.omega = omega_0 if first else omega_hidden
        self.register_parameter("log_beta", None)  # a plain sine has no sharpness
        if self.omega <= 0:
            raise ValueError(f"omega_0 and omega_hidden must be positive, got {self.omega}")

    def weight_bound(self, fan_in: int) -> float:
        return 1 / fan_in if self.first else math.sqrt(6 / fan_in) / self.omega

    def forward(self, x: Tensor) -> Tensor:
        return torch.sin(self.omega * x)

    def with_slope(self, x: Tensor) -> tuple[Tensor, Tensor]:
        angle = self.omega * x
        return torch.sin(angle), self.omega * torch.cos(angle)

    def shifted(
        self, product: Tensor, shift: Tensor, beside: Tensor | None = None, dropout: float = 0.0
    ) -> Tensor:
        if dropout or not fits(product):
            return super().shifted(product, shift, beside, dropout)
        return Wave.apply(product, shift, self.log_beta, beside, self.omega, self.with_slope, False)

    def shifted_with_slope(
        self, product: Tensor, shift: Tensor, beside: Tensor | None = None, dropout: float = 0.0
    ) -> tuple[Tensor, Tensor]:
        if dropout or not fits(product):
            return super().shifted_with_slope(product, shift, beside, dropout)
        return Wave.apply(product, shift, self.log_beta, beside, self.omega, self.with_slope, True)

    def monitored(self) -> dict[str, float]:
        return {"omega": self.omega}


class Hosc(Siren):
    """tanh(beta sin(omega x)), with a learnable sharpness beta > 0 per layer.

    beta is kept positive by learning its logarithm. The gain of a layer grows with beta (about 1.4 at 2,
    1.9 at 4, with SIREN's initialisation), so a deep decoder needs a small one.

    Source: the paper's equation for HOSC (Serrano et al. 2024).

    Args:
        omega_0: frequency factor of the first layer, > 0.
        omega_hidden: frequency factor of every other layer, > 0.
        beta: initial sharpness, > 0; near 0 a scaled sine, large a square wave.
        learn_beta: whether beta is trained with the decoder's weights.
        first: whether it follows the layer that reads the encoded points.
    """

    def __init__(
        self, omega_0: float, omega_hidden: float, beta: float, learn_beta: bool = True, first: bool = False
    ):
        super().__init__(omega_0, omega_hidden, first)
        if beta <= 0:
            raise ValueError(f"beta must be positive, got {beta}")
        self.log_beta = nn.Parameter(torch.tensor(math.log(beta)), requires_grad=learn_beta)

    @property
    def beta(self) -> Tensor:
        """Sharpness of this layer: a positive scalar tensor."""
        return self.log_beta.exp()

    def forward(self, x: Tensor) -> Tensor:
        return torch.tanh(self.beta * torch.sin(self.omega * x))

    def with_slope(self, x: Tensor) -> tuple[Tensor, Tensor]:
        sine, slope = super().with_slope(x)
        wave = torch.tanh(self.beta * sine)
        return wave, self.beta * slope * (1 - wave * wave)

    def monitored(self) -> dict[str, float]:
        return {"omega": self.omega, "beta": self.beta.item()}


class Finer(Activation):
    """sin(omega (|x| + 1) x): a sine whose frequency grows away from zero, so that biases choose frequencies.

    Initialised as SIREN is, but for the first layer's biases, which are spread over U(-k, k). The authors'
    code holds |x| + 1 fixed while it differentiates; here it is differentiated, because a normal is the
    field's own slope.

    Source: Liu et al. 2024 (FINER), and its published code for the first biases.

    Args:
        omega_0: frequency factor of the first layer at x = 0, > 0.
        omega_hidden: frequency factor of every other layer at x = 0, > 0.
        k: half-width of the first layer's initial biases, > 0; frequencies reach (2k + 1) omega.
        first: whether it follows the layer that reads the encoded points.
    """

    def __init__(self, omega_0: float, omega_hidden: float, k: float, first: bool = False):
        super().__init__(first)
        self.omega, self.k = omega_0 if first else omega_hidden, k
        if min(self.omega, k) <= 0:
            raise ValueError(f"omega_0, omega_hidden and k must be positive, got {self.omega} and {k}")

    def weight_bound(self, fan_in: int) -> float:
        return 1 / fan_in if self.first else math.sqrt(6 / fan_in) / self.omega

    def bias_bound(self) -> float | None:
        return self.k if self.first else None

    def forward(self, x: Tensor) -> Tensor:
        return torch.sin(self.omega * (x.abs() + 1) * x)

    def with_slope(self, x: Tensor) -> tuple[Tensor, Tensor]:
        size = x.abs()
        angle = self.omega * (size + 1) * x
        return torch.sin(angle), self.omega * (2 * size + 1) * torch.cos(angle)

    def monitored(self) -> dict[str, float]:
        return {"omega": self.omega}


class Gauss(Activation):
    """exp(-x^2 / (2 a^2)), initialised as PyTorch's linear layers are.

    Source: Ramasinghe and Lucey 2022; they draw weights by several laws and find that it matters
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

    Source: Saragadam et al. 2023 (WIRE), and its published code.

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
