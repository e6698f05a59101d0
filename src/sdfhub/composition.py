"""A composed config as objects and as plain data. Whatever the user's own config names is made."""

import inspect
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import hydra
from hydra.errors import InstantiationException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from omegaconf.resolvers import oc

import sdfhub
from sdfhub.described import RESERVED, check_arguments, located
from sdfhub.errors import SdfhubError


def configuration_folder() -> Path:
    """The folder of YAMLs: inside an installed package, beside `src/` in a checkout."""
    package = Path(sdfhub.__file__).resolve().parent
    inside = package / "conf"
    return inside if inside.is_dir() else package.parents[1] / "conf"


def one_line(error: BaseException) -> str:
    """What a user needs of an error: what is wrong, in one line."""
    if isinstance(error, OSError) and error.filename:
        return f"{error.filename}: {(error.strerror or 'cannot be used').lower()}"
    if isinstance(error, MemoryError):
        return f"out of memory: {error}; lower resolution, points or samples"
    lines = [line.strip() for line in str(error).splitlines() if line.strip()] or [type(error).__name__]
    return lines[0] if isinstance(error, OmegaConfBaseException) else " ".join(lines)


def instantiate(config: Any, key: str, **given: Any) -> Any:
    """The object that a node at `key` of the user's own config describes, checked before it is made."""
    node = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    _check(node, key, given)
    try:
        return hydra.utils.instantiate(node, _convert_="all", **given)
    except InstantiationException as error:
        cause = error.__cause__ or error
        if isinstance(cause, SdfhubError | KeyboardInterrupt):
            raise cause from error
        raise SdfhubError(f"{key}: {one_line(cause)}") from error


def drop_replaced(config: DictConfig, words: Sequence[str]) -> None:
    """Where a word such as `activation._target_=mypkg.Mine` replaces a class, drops settings of the old one
    but for those that the new one takes or that a word gives."""
    given = {word.lstrip("+").partition("=")[0] for word in words}
    for key in given:
        node_key, _, name = key.rpartition(".")
        node = OmegaConf.select(config, node_key)
        if name != "_target_" or node_key == "optim" or not isinstance(node, DictConfig):
            continue  # an optimiser of PyTorch leaves the other settings of `optim` to sdfhub
        target = located(node._target_, node_key)
        if not (inspect.isclass(target) or inspect.isfunction(target)):
            continue  # a compiled function does not say what it takes
        hands_on = inspect.getfullargspec(target).varkw is not None  # to its bases
        kinds = inspect.getmro(target) if hands_on and inspect.isclass(target) else (target,)
        takes = {name for kind in kinds for name in inspect.signature(kind).parameters}
        OmegaConf.set_struct(node, False)
        for setting in set(node) - {*takes, *RESERVED}:
            if f"{node_key}.{setting}" not in given:
                del node[setting]


def _check(node: Any, key: str, given: Mapping[str, Any] | None = None) -> None:
    is_mapping = isinstance(node, Mapping)
    for name, item in node.items() if is_mapping else enumerate(node if isinstance(node, list) else ()):
        _check(item, f"{key}.{name}")
    if is_mapping and "_target_" in node and "_args_" not in node:
        arguments = {name: value for name, value in node.items() if name not in RESERVED}
        check_arguments(located(node["_target_"], key), {**arguments, **(given or {})}, key)


def plain(config: DictConfig) -> dict[str, Any]:
    """A config as plain data, interpolations resolved but `${oc.env:NAME}`, which may be a password."""
    written = lambda *words: "${oc.env:" + ",".join(map(str, words)) + "}"  # noqa: E731
    OmegaConf.register_new_resolver("oc.env", written, replace=True)
    try:
        return cast(dict[str, Any], OmegaConf.to_container(config, resolve=True, throw_on_missing=True))
    finally:
        OmegaConf.register_new_resolver("oc.env", oc.env, replace=True)


def with_absolute_paths(node: Any) -> Any:
    """Plain data in which relative paths of what is there are absolute, so that they hold from anywhere."""
    if isinstance(node, Mapping):
        return {name: with_absolute_paths(value) for name, value in node.items()}
    if isinstance(node, str) and "/" in node and not Path(node).is_absolute() and Path(node).exists():
        return str(Path(node).absolute())
    return node
