"""From a composed config to objects: the signature of a class is the schema of its YAML."""

import importlib
import inspect
import typing
from collections.abc import Mapping
from functools import partial
from typing import Annotated, Any

from omegaconf import DictConfig, OmegaConf
from pydantic import ConfigDict, Field, TypeAdapter, ValidationError

from sdfhub.errors import SdfhubError

Seed = Annotated[int, Field(ge=0, lt=2**31)]


def plain(config: DictConfig) -> dict[str, Any]:
    """A config as plain dicts, lists, numbers and strings, with every interpolation resolved."""
    return OmegaConf.to_container(config, resolve=True, throw_on_missing=True)


def build(node: Mapping[str, Any], key: str, within: str = "sdfhub", **given: Any) -> Any:
    """Makes the object that a config node describes, its arguments checked against their annotations.

    Args:
        node: plain mapping with `_target_` (a dotted class path), optionally `_partial_`, and arguments;
            arguments that are such mappings themselves are built first.
        key: where the node stands in the config, for messages.
        within: package in which the class must live; what a stranger's file names is never imported.
        given: arguments that come from code.

    Returns:
        The instance, or a `functools.partial` of the class where `_partial_` is true.

    Raises:
        SdfhubError: an unknown class or argument, a missing argument, a value of the wrong type or range.
    """
    target = _locate(node.get("_target_"), key, within)
    arguments = {name: value for name, value in node.items() if name not in ("_target_", "_partial_")}
    signature = inspect.signature(target).parameters
    for name in arguments:
        if name not in signature:
            own = [each for each in signature if each not in given]
            raise SdfhubError(f"{key}.{name}: no such setting; {target.__name__} knows {', '.join(own)}")
        if name in given:
            raise SdfhubError(f"{key}.{name}: is no setting; it follows from the rest")
    hints = typing.get_type_hints(target.__init__)
    for name, value in arguments.items():
        where = f"{key}.{name}"
        if isinstance(value, Mapping) and "_target_" in value:
            arguments[name] = build(value, where, within)
        else:
            arguments[name] = check(value, hints.get(name, Any), where)
    if node.get("_partial_"):
        return partial(target, **arguments, **given)
    missing = [
        name
        for name, parameter in signature.items()
        if parameter.default is parameter.empty
        and parameter.kind not in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD)
        and name not in arguments | given
    ]
    if missing:
        raise SdfhubError(f"{key}.{missing[0]}: must be set")
    try:
        return target(**arguments, **given)
    except ValueError as error:
        raise SdfhubError(f"{key}: {error}") from error


def check(value: Any, hint: Any, key: str) -> Any:
    """`value` as the annotation `hint` wants it (an int where a float is due is one), or one clear line."""
    try:
        lenient = ConfigDict(arbitrary_types_allowed=True, strict=False, allow_inf_nan=False)
        adapter = TypeAdapter(hint, config=lenient)
    except Exception:  # pydantic cannot judge every annotation, nor take a config for a dataclass
        adapter = TypeAdapter(hint)
    try:
        return adapter.validate_python(value)
    except ValidationError as error:
        wrong = error.errors()
        # only what indexes the value belongs to its place; pydantic adds the branches of a union
        inner = wrong[0]["loc"] if isinstance(value, Mapping | list) else ()
        place = ".".join([key, *map(str, inner)])
        wanted = " or ".join(dict.fromkeys(one["msg"].lower().removeprefix("input ") for one in wrong))
        raise SdfhubError(f"{place}={wrong[0]['input']!r}: {wanted}") from error


def _locate(path: Any, key: str, within: str) -> type:
    if not isinstance(path, str) or not path.startswith(within + "."):
        raise SdfhubError(f"{key}._target_: {path!r} is not a class of {within}")
    module, _, name = path.rpartition(".")
    try:
        found = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise SdfhubError(f"{key}._target_: there is no {path}") from error
    is_ours = inspect.isclass(found) and f"{found.__module__}.".startswith(within + ".")
    if not is_ours or issubclass(found, BaseException):  # a mistake has no settings
        raise SdfhubError(f"{key}._target_: {path!r} is not a class of {within}")
    return found
