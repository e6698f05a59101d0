"""Nonlinearities of the decoder, one instance per hidden layer.

Each rival is a module with four duties: `forward`; `with_slope`, the same beside its derivative, from which
the decoder computes spatial gradients; `chain`, the chain rule through both, written out so that it can run
in blocks; and `weight_bound`, the half-width of the uniform distribution from which the weights of the linear
layer before it are drawn.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor, nn


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

    @abstractmethod
    def chain(
        self, x: Tensor, by_value: Tensor, by_slope: Tensor | None = None
    ) -> tuple[Tensor, Sequence[Tensor]]:
        """Cotangents of x and of each parameter from those of a(x) and, where it was used, of a'(x)."""

    @abstractmethod
    def weight_bound(self, fan_in: int) -> float:
        """Half-width b of U(-b, b), the initial weights of the layer before, for `fan_in` inputs."""

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

    def chain(self, x, by_value, by_slope=None):
        return by_value.masked_fill(x <= 0, 0), ()


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
        if self.omega <= 0:
            raise ValueError(f"omega_0 and omega_hidden must be positive, got {self.omega}")

    def weight_bound(self, fan_in: int) -> float:
        return 1 / fan_in if self.first else math.sqrt(6 / fan_in) / self.omega

    def forward(self, x: Tensor) -> Tensor:
        return torch.sin(self.omega * x)

    def with_slope(self, x: Tensor) -> tuple[Tensor, Tensor]:
        angle = self.omega * x
        return torch.sin(angle), self.omega * torch.cos(angle)

    def chain(self, x, by_value, by_slope=None):
        angle = self.omega * x
        by_x = torch.cos(angle).mul_(self.omega).mul_(by_value)
        if by_slope is not None:
            by_x.addcmul_(angle.sin_(), by_slope, value=-(self.omega**2))
        return by_x, ()

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

    def chain(self, x, by_value, by_slope=None):
        # With u = beta sin(omega x), v = u', a = tanh(u) and d = 1 - a^2:
        # a' = d v, a'' = -d (omega^2 u + 2 a v^2); by log beta, a grows as d u and a' as d (v - 2 a v u).
        angle = self.omega * x
        u, v = torch.sin(angle).mul_(self.beta), angle.cos_().mul_(self.omega * self.beta)
        wave = torch.tanh(u)
        by_u = _damped(by_value, wave)
        by_log_beta = torch.vdot(by_u.flatten(), u.flatten())
        if by_slope is None:
            return by_u.mul_(v), [by_log_beta]
        by_v = _damped(by_slope, wave)
        bent = wave.mul_(v).mul_(2)
        by_log_beta += torch.vdot(by_v.flatten(), torch.addcmul(v, bent, u, value=-1).flatten())
        return by_u.mul_(v).addcmul_(by_v, bent.mul_(v).add_(u, alpha=self.omega**2), value=-1), [by_log_beta]

    def monitored(self) -> dict[str, float]:
        return {"omega": self.omega, "beta": self.beta.item()}


def _damped(cotangent: Tensor, wave: Tensor) -> Tensor:
    """cotangent * (1 - wave^2), tanh's chain rule."""
    return torch.addcmul(cotangent, cotangent * wave, wave, value=-1)
