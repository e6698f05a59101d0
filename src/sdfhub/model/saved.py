"""A model from what a file holds: descriptions of its parts, and weights that agree with them."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor, nn
from torch.utils._pytree import tree_leaves

from sdfhub.described import built
from sdfhub.errors import SdfhubError
from sdfhub.model.decoder import Decoder

Model = TypeVar("Model", bound=nn.Module)

PARTS = dict.fromkeys(("decoder", "codes", "loss", "optim", "computing"), "sdfhub.model")
PARTS |= {"validation": "sdfhub"}
"""Descriptions among the hyper-parameters of a checkpoint, and where their classes live."""


def built_parts(parameters: Any, path: Path, trust: str | Sequence[str] = ()) -> dict[str, Any]:
    """The constructor's arguments of an auto-decoder, from the hyper-parameters of a checkpoint."""
    if not isinstance(parameters, Mapping) or not {"decoder", "shapes"} <= parameters.keys():
        raise SdfhubError(f"{path}: describes no auto-decoder; give a checkpoint that a training wrote")
    parts = {name: built(parameters.get(name), name, trust, within) for name, within in PARTS.items()}
    return {**parts, "shapes": parameters["shapes"], "seed": parameters.get("seed", 0)}


def saved_decoder(
    description: Any, weights: Mapping[str, Tensor], path: Path, trust: str | Sequence[str] = ()
) -> Decoder:
    """The decoder of a plain description with its `state_dict`, in evaluation mode and without gradients."""
    make = partial(built, description, "decoder", trust, within="sdfhub.model")
    return model_with_weights(make, description, weights, path).eval().requires_grad_(False)


def model_with_weights(make: Callable[[], Model], description: Any, weights: Any, path: Path) -> Model:
    """The model that `make` makes of a description, with its `state_dict`.

    Nothing is made that is larger than the weights: a few bytes of description could ask for any size.
    """
    if not isinstance(weights, Mapping) or not all(
        isinstance(weight, Tensor) and weight.is_contiguous() for weight in weights.values()
    ):  # a view may claim more numbers than its file holds
        raise SdfhubError(f"{path}: holds no weights of a model; give a checkpoint that a training wrote")
    size = sum(weight.numel() for weight in weights.values())
    decoder = description.get("decoder", description) if isinstance(description, Mapping) else {}
    for value in tree_leaves(decoder):
        if isinstance(value, int | float) and value > max(size, 64):
            raise SdfhubError(f"{path}: {value} is more than a decoder of {size} weights can have")
    try:
        with torch.device("meta"):
            make().load_state_dict(weights, assign=True)  # refuses other names and shapes
        with torch.random.fork_rng(devices=[]):  # initial weights are drawn, though only to be replaced
            model = make()
        model.load_state_dict(weights)
    except SdfhubError as error:
        raise SdfhubError(f"{path}: {error}") from error
    except (RuntimeError, TypeError, AttributeError, ArithmeticError) as error:
        reason = " ".join(str(error).split())[:200]
        raise SdfhubError(f"{path}: holds another model than it describes: {reason}") from error
    return model
