"""The shell around every task: Hydra composes, objects are made once, a user's mistake becomes one line."""

import logging
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import hydra
from hydra.errors import InstantiationException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from omegaconf.resolvers import oc

import sdfhub
from sdfhub.described import RESERVED, check_arguments, located
from sdfhub.errors import SdfhubError
from sdfhub.multirun.names import register_resolvers
from sdfhub.tasks.words import words_to_overrides

log = logging.getLogger(__name__)

Task = Callable[[DictConfig], float | None]
"""What a command does with its composed config; a search lowers what is returned."""


def configuration_folder() -> Path:
    """The folder of YAMLs: inside an installed package, beside `src/` in a checkout."""
    package = Path(sdfhub.__file__).resolve().parent
    inside = package / "conf"
    return inside if inside.is_dir() else package.parents[1] / "conf"


def run_task(task: Task, config_name: str, positional: Sequence[str] = ()) -> None:
    """Composes `config_name` with the command line's overrides and runs `task` on it.

    Exit status: 0, 2 after a user's mistake (one line on stderr, no traceback), 130 after Ctrl-C; 1 where
    Hydra refuses the command line. HYDRA_FULL_ERROR=1 in the environment shows tracebacks.

    Args:
        task: given each composed config.
        config_name: a YAML of conf/.
        positional: keys that words without `=` stand for, in their order; the last takes all that are left.
    """
    sys.argv[1:] = words_to_overrides(sys.argv[1:], positional)
    register_resolvers()
    refused: list[str] = []
    process, verbose = os.getpid(), os.environ.get("HYDRA_FULL_ERROR") == "1"

    def guarded(config: DictConfig) -> float | None:
        try:
            return task(config)
        except (SdfhubError, OmegaConfBaseException, OSError, MemoryError) as error:
            if verbose:
                raise
            if os.getpid() != process:  # in a launcher's worker only what is raised comes home
                raise SdfhubError(one_line(error)) from None
            refused.append(one_line(error))
        return None

    app = hydra.main(version_base="1.3", config_path=str(configuration_folder()), config_name=config_name)
    try:
        app(guarded)()
    except KeyboardInterrupt:
        print("sdfhub: interrupted", file=sys.stderr)
        sys.exit(130)
    except BrokenPipeError:  # `--help | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    for line in refused:
        print(f"sdfhub: error: {line}", file=sys.stderr)
    if refused:
        sys.exit(2)


def one_line(error: BaseException) -> str:
    """What a user needs of an error: what is wrong, in one line."""
    if isinstance(error, OSError) and error.filename:
        return f"{error.filename}: {(error.strerror or 'cannot be used').lower()}"
    if isinstance(error, MemoryError):
        return f"out of memory: {error}; lower resolution, points or samples"
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return (lines[0] if isinstance(error, OmegaConfBaseException) else " ".join(lines)) or type(error).__name__


def instantiate(config: Any, key: str, **given: Any) -> Any:
    """The object that a node of the user's own config describes: `hydra.utils.instantiate`, checked before.

    Args:
        config: a node with `_target_`, or a mapping or list of such; None stays None.
        key: where it stands in the config, for messages.
        given: arguments that come from code.

    Raises:
        SdfhubError: no such class or argument, a value of the wrong type, or what the class says of it.
    """
    node = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    _check(node, key, given)
    try:
        return hydra.utils.instantiate(node, _convert_="all", **given)
    except InstantiationException as error:
        cause = error.__cause__ or error
        if isinstance(cause, SdfhubError | KeyboardInterrupt):
            raise cause from error
        raise SdfhubError(f"{key}: {one_line(cause)}") from error


def _check(node: Any, key: str, given: Mapping[str, Any] | None = None) -> None:
    if isinstance(node, list):
        for number, item in enumerate(node):
            _check(item, f"{key}.{number}")
    if not isinstance(node, Mapping):
        return
    for name, value in node.items():
        _check(value, f"{key}.{name}")
    if "_target_" in node and "_args_" not in node:
        arguments = {name: value for name, value in node.items() if name not in RESERVED}
        check_arguments(located(node["_target_"], key), {**arguments, **(given or {})}, key)


def plain(config: DictConfig) -> dict[str, Any]:
    """A config as plain data with its interpolations resolved, but `${oc.env:NAME}` as it is written.

    The environment holds keys and passwords; a run's config is written down and passed on.
    """
    written = lambda *words: "${oc.env:" + ",".join(map(str, words)) + "}"  # noqa: E731
    OmegaConf.register_new_resolver("oc.env", written, replace=True)
    try:
        return OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    finally:
        OmegaConf.register_new_resolver("oc.env", oc.env, replace=True)


def with_environment(node: Any) -> Any:
    """Plain data with `${oc.env:NAME}` replaced by this machine's environment."""
    if isinstance(node, Mapping):
        return {name: with_environment(value) for name, value in node.items()}
    if isinstance(node, str) and "${oc.env:" in node:
        return OmegaConf.to_container(OmegaConf.create([node]), resolve=True)[0]
    return node


def with_absolute_paths(node: Any) -> Any:
    """Plain data in which relative paths of what is there are absolute, so that they hold from anywhere."""
    if isinstance(node, Mapping):
        return {name: with_absolute_paths(value) for name, value in node.items()}
    if isinstance(node, str) and "/" in node and not Path(node).is_absolute() and Path(node).exists():
        return str(Path(node).absolute())
    return node
