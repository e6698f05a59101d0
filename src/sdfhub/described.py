"""Objects as plain data and back: what a checkpoint, an export and a config say of a model.

A description is a mapping with `_target_`, the dotted path of a class, and the arguments of its constructor,
as in a Hydra config; `_partial_` marks a factory.
"""

import contextlib
import dataclasses
import functools
import inspect
import pkgutil
import typing
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import ConfigDict, TypeAdapter, ValidationError

from sdfhub.errors import SdfhubError

OF_PYTORCH = ("torch.nn.", "torch.optim.")  # built from a file too: they do nothing but compute
RESERVED = ("_target_", "_partial_", "_args_", "_recursive_", "_convert_")  # keys that are no arguments


class Described:
    """An object whose constructor's arguments are checked by their annotations, and kept for `describe`."""

    def __init_subclass__(cls, **settings: Any):
        super().__init_subclass__(**settings)
        if "__init__" not in vars(cls):
            return
        initialise: Any = cls.__init__
        signature = inspect.signature(initialise)

        @functools.wraps(initialise)
        def remember(self, *arguments: Any, **named: Any) -> None:
            given = dict(list(signature.bind(self, *arguments, **named).arguments.items())[1:])
            check_arguments(initialise, given, type(self).__name__)
            self.__dict__.setdefault("_arguments", given)  # those of a class below this one came first
            initialise(self, *arguments, **named)

        cls.__init__ = typing.cast(Any, remember)  # type: ignore[method-assign]


def describe(value: Any, key: str = "") -> Any:
    """As plain data: such data, a class, a `functools.partial`, a dataclass or a `Described`, nested."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Mapping):
        return {str(name): describe(item, f"{key}.{name}") for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [describe(item, key) for item in value]
    if isinstance(value, functools.partial):
        named = inspect.signature(value.func).bind_partial(*value.args).arguments | value.keywords
        return {"_target_": _path(value.func), "_partial_": True, **describe(named, key)}
    if inspect.isclass(value) or inspect.isfunction(value):
        return {"_target_": _path(value), "_partial_": True}
    if dataclasses.is_dataclass(value):
        arguments = {f.name: getattr(value, f.name) for f in dataclasses.fields(value) if f.init}
    elif isinstance(value, Described):
        arguments = vars(value).get("_arguments", {})
    else:
        raise SdfhubError(f"{key}: {_path(type(value))} cannot say how it was made; make it a dataclass")
    return {"_target_": _path(type(value)), **describe(arguments, key)}


def _path(kind: Callable) -> str:
    return f"{kind.__module__}.{kind.__qualname__}"


def built(node: Any, key: str, trust: str | Sequence[str] = (), within: str = "sdfhub") -> Any:
    """The object of a description from a file; its classes are of the packages `within` and `trust`."""
    if isinstance(node, list):
        return [built(item, key, trust, within) for item in node]
    if not isinstance(node, Mapping):
        return node
    named = {name: value for name, value in node.items() if name not in RESERVED}
    arguments = {name: built(value, f"{key}.{name}", trust, within) for name, value in named.items()}
    if "_target_" not in node:
        return arguments
    target = _trusted(node["_target_"], key, trusted_packages(trust), within)
    check_arguments(target, arguments, key)
    if node.get("_partial_"):
        return functools.partial(target, **arguments)
    try:
        return target(**arguments)
    except (TypeError, ValueError) as error:
        raise SdfhubError(f"{key}: {error}") from error


def trusted_packages(trust: str | Sequence[str] | None) -> tuple[str, ...]:
    """Names from one name, several, or text such as `mypkg,other`."""
    names = trust.split(",") if isinstance(trust, str) else list(trust or ())
    return tuple(name.strip() for name in names if name.strip())


def _trusted(path: Any, key: str, trust: tuple[str, ...], within: str) -> Callable:
    package, ours = str(path).partition(".")[0], (f"{within}.", *OF_PYTORCH)
    if package in trust:
        return located(path, key)
    if str(path).startswith(ours):
        target = located(path, key)
        if inspect.isclass(target) and target.__module__.startswith(ours):
            return target
    wanted = f"{key}: the file asks for {path!r}, which is no class of {within}"
    raise SdfhubError(f"{wanted}; trust={package} builds it, if you know that package")


def located(path: str, key: str) -> Callable:
    """The class or function of a dotted path."""
    try:
        target = pkgutil.resolve_name(str(path))
        if callable(target):
            return target
        reason: object = f"it is a {type(target).__name__}"
    except (ImportError, AttributeError, ValueError) as error:
        reason = error
    raise SdfhubError(f"{key}: there is no class {path} ({reason}); is its package on the Python path?")


def check_arguments(target: Callable, arguments: Mapping[str, Any], key: str) -> None:
    """Refuses arguments that a class or function does not take, or of another type than it annotates."""
    try:
        signature = inspect.signature(target).parameters
    except (TypeError, ValueError):  # a class that is compiled
        return
    takes_any = any(parameter.kind is parameter.VAR_KEYWORD for parameter in signature.values())
    hints = {}
    if target.__module__.partition(".")[0] != "torch":  # checks its own arguments, and annotates some wrongly
        is_class = inspect.isclass(target) and not dataclasses.is_dataclass(target)
        with contextlib.suppress(Exception):  # an annotation that cannot be read at run time checks nothing
            hints = typing.get_type_hints(target.__init__ if is_class else target, include_extras=True)
    for name, value in arguments.items():
        if name not in signature and not takes_any:
            known = ", ".join(signature) or "no arguments"
            raise SdfhubError(f"{key}.{name}: no such setting; {target.__name__} takes {known}")
        if name in hints and (value is None or isinstance(value, bool | int | float | str | list)):
            check(value, hints[name], f"{key}.{name}")


def check(value: Any, hint: Any, key: str) -> Any:
    """The value as its annotation wants it; an int where a float is due is one."""
    config = ConfigDict(arbitrary_types_allowed=True, allow_inf_nan=False)
    own = hasattr(hint, "__pydantic_validator__")  # a model of pydantic has a config of its own
    try:
        return TypeAdapter(hint, config=None if own else config).validate_python(value)
    except ValidationError as error:
        problems = error.errors()
        if isinstance(value, Mapping):  # names the first fault in it
            problems = problems[:1]
            key, value = ".".join(map(str, (key, *problems[0]["loc"]))), problems[0]["input"]
        wanted = dict.fromkeys(problem["msg"].lower().removeprefix("input ") for problem in problems)
        raise SdfhubError(f"{key}={value!r}: {' or '.join(wanted)}") from error
