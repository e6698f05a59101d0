"""Nonlinearities of the decoder, one instance per hidden layer.

A rival needs `forward` alone. It may also state its slope (`with_slope`, autograd's by default) and how the
linear layer before it is initialised (`weight_bound`, `bias_bound`; PyTorch's law by default).
"""

import copy
import inspect
import math
from abc import ABC, abstractmethod
from collections.abc import Callable

import torch
from pydantic import PositiveFloat
from torch import Tensor, nn

from sdfhub.described import Described
from sdfhub.model.derivatives import value_and_pullback


class Activation(Described, nn.Module, ABC):
    """An elementwise nonlinearity that knows how the layer before it must be initialised.

    Args:
        first: whether it follows the layer that reads the encoded points.
    """

    def __init__(self, first: bool = False):
        super().__init__()
        self.first = first

    @abstractmethod
    def forward(self, x: Tensor) -> Tensor:
        """a(x), shaped like x and twice differentiable."""

    def with_slope(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """a(x) and a'(x), both shaped like x and both differentiable."""
        value, pullback = value_and_pullback(self, x)
        return value, pullback(torch.ones_like(value))

    def weight_bound(self, fan_in: int) -> float:
        """Half-width b of U(-b, b), the initial weights of the layer before, for `fan_in` inputs."""
        return 1 / math.sqrt(fan_in)

    def bias_bound(self) -> float | None:
        """Half-width of the initial biases before it; None keeps PyTorch's, U(+-1/sqrt(fan_in))."""
        return None

    def monitored(self) -> dict[str, float]:
        """Numbers worth a curve while training, by name; none by default."""
        return {}


class Elementwise(Activation):
    """A module that acts on each number by itself, such as `torch.nn.GELU`, as an activation."""

    def __init__(self, function: nn.Module, first: bool = False):
        super().__init__(first)
        self.function = function

    def forward(self, x: Tensor) -> Tensor:
        return self.function(x)


def new_activation(make: Callable[..., nn.Module] | nn.Module, first: bool) -> Activation:
    """One layer's activation: a copy of a module, or what a class, partial or factory makes.

    It is called with `first`, whether it is the first layer's, where it takes that.
    """
    if isinstance(make, nn.Module):
        activation = copy.deepcopy(make)
    else:
        arguments, kind = inspect.signature(make).parameters, getattr(make, "func", make)
        is_ours = isinstance(kind, type) and issubclass(kind, Activation)  # every module takes **kwargs
        takes_first = "first" in arguments or (is_ours and "kwargs" in arguments)
        activation = make(first=first) if takes_first else make()
    if not isinstance(activation, nn.Module):
        raise ValueError(f"activation must make a torch.nn.Module, got {type(activation).__name__}")
    return activation if isinstance(activation, Activation) else Elementwise(activation, first)


class Relu(Activation):
    """max(0, x), DeepSDF's choice."""

    def forward(self, x: Tensor) -> Tensor:
        return torch.relu(x)

    def with_slope(self, x: Tensor) -> tuple[Tensor, Tensor]:
        return torch.relu(x), (x > 0).to(x.dtype)


class Siren(Activation):
    """sin(omega x), with one omega for the first layer and one for the others.

    Source: Sitzmann et al. 2020, section 3.2: first layer U(-1/n, 1/n), others U(+-sqrt(6/n) / omega).
    """

    def __init__(self, omega_0: PositiveFloat, omega_hidden: PositiveFloat, first: bool = False):
        super().__init__(first)
        self.omega = omega_0 if first else omega_hidden

    def weight_bound(self, fan_in: int) -> float:
        return 1 / fan_in if self.first else math.sqrt(6 / fan_in) / self.omega

    def forward(self, x: Tensor) -> Tensor:
        return torch.sin(self.omega * x)

    def with_slope(self, x: Tensor) -> tuple[Tensor, Tensor]:
        angle = self.omega * x
        return torch.sin(angle), self.omega * torch.cos(angle)

    def monitored(self) -> dict[str, float]:
        return {"omega": self.omega}


class Hosc(Siren):
    """tanh(beta sin(omega x)), with a learnable sharpness beta > 0 per layer.

    beta is kept positive by learning its logarithm. The gain of a layer grows with beta (about 1.4 at 2,
    1.9 at 4, with SIREN's initialisation), so a deep decoder needs a small one.

    Source: the paper's equation for HOSC (Serrano et al. 2024).

    Args:
        omega_0, omega_hidden: as in `Siren`.
        beta: initial sharpness, > 0; near 0 a scaled sine, large a square wave.
        learn_beta: whether beta is trained.
    """

    def __init__(
        self,
        omega_0: PositiveFloat,
        omega_hidden: PositiveFloat,
        beta: PositiveFloat,
        learn_beta: bool = True,
        first: bool = False,
    ):
        super().__init__(omega_0, omega_hidden, first)
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


class Finer(Siren):
    """sin(omega (|x| + 1) x): a sine whose frequency grows away from zero, so that biases choose frequencies.

    Initialised as SIREN is, but for the first layer's biases, which are spread over U(-k, k). The authors'
    code holds |x| + 1 fixed while it differentiates; here, where a normal is the field's slope, it is not.
    Frequencies reach (2k + 1) omega.

    Source: Liu et al. 2024 (FINER), and its published code for the first biases.
    """

    def __init__(
        self, omega_0: PositiveFloat, omega_hidden: PositiveFloat, k: PositiveFloat, first: bool = False
    ):
        super().__init__(omega_0, omega_hidden, first)
        self.k = k

    def bias_bound(self) -> float | None:
        return self.k if self.first else None

    def forward(self, x: Tensor) -> Tensor:
        return torch.sin(self.omega * (x.abs() + 1) * x)

    with_slope = Activation.with_slope


class Gauss(Activation):
    """exp(-x^2 / (2 a^2)); a narrow bump gives features of higher rank and a steeper field.

    Source: Ramasinghe and Lucey 2022, who find that the law of the initial weights matters little for it.
    """

    def __init__(self, a: PositiveFloat, first: bool = False):
        super().__init__(first)
        self.a = a

    def forward(self, x: Tensor) -> Tensor:
        return torch.exp(-0.5 * (x / self.a).square())


class Wire(Siren):
    """cos(omega x) exp(-(s x)^2), initialised as PyTorch's linear layers are.

    The real part of the complex Gabor wavelet exp(i omega x) exp(-|s x|^2), whose wave and bump share one
    linear map, as here; the real layer in the authors' code has two.

    Source: Saragadam et al. 2023 (WIRE), and its published code.
    """

    def __init__(
        self, omega_0: PositiveFloat, omega_hidden: PositiveFloat, s: PositiveFloat, first: bool = False
    ):
        super().__init__(omega_0, omega_hidden, first)
        self.s = s

    weight_bound, with_slope = Activation.weight_bound, Activation.with_slope

    def forward(self, x: Tensor) -> Tensor:
        return torch.cos(self.omega * x) * torch.exp(-(self.s * x).square())
