"""The shell around every task: plain words become Hydra's, a user's mistake becomes one line."""

import os
import re
import sys
from collections.abc import Callable, Sequence

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.types import Quote, QuotedString
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from sdfhub.composition import configuration_folder, drop_replaced, one_line
from sdfhub.errors import SdfhubError
from sdfhub.multirun.names import register_resolvers

# Hydra's options whose value is the next word
TAKES_A_VALUE = ("--config-path", "-cp", "--config-name", "-cn", "--config-dir", "-cd", "--package", "-p")


def run_task(task: Callable[[DictConfig], float | None], config_name: str, positional: Sequence[str]) -> None:
    """Composes `config_name` with the command line's words and runs `task`, whose result a search lowers.

    Exit status: 0, 2 after a user's mistake (one line on stderr, no traceback), 130 after Ctrl-C; 1 where
    Hydra refuses the command line. HYDRA_FULL_ERROR=1 in the environment shows tracebacks.
    """
    sys.argv[1:] = words_to_overrides(sys.argv[1:], positional)
    register_resolvers()
    refused: list[str] = []
    process, verbose = os.getpid(), os.environ.get("HYDRA_FULL_ERROR") == "1"

    def guarded(config: DictConfig) -> float | None:
        try:
            drop_replaced(config, HydraConfig.get().overrides.task)
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


def words_to_overrides(argv: Sequence[str], names: Sequence[str]) -> list[str]:
    """A command line's words, in which positional ones have become `name=value`.

    Names that the line also gives as `name=value` are left out; the last may end with `...` and takes any
    number of words. Words beyond the names stay as they are, for Hydra to refuse.

    >>> words_to_overrides(["my run", "a.ply", "b,c.ply", "frame=unknown"], ["run", "scans..."])
    ["run='my run'", 'frame=unknown', "scans=['a.ply','b,c.ply']"]
    """
    given = {word.partition("=")[0] for word in argv if not is_positional(word)}
    left = [name for name in names if name.removesuffix("...") not in given]
    overrides, many = list[str](), list[str]()
    for before, word in zip(["", *argv], argv, strict=False):
        if before in TAKES_A_VALUE or not is_positional(word) or not left:
            overrides.append(word)
        elif left[0].endswith("..."):
            many.append(quoted(word))
        else:
            overrides.append(f"{left.pop(0)}={quoted(word)}")
    return [*overrides, f"{left[0].removesuffix('...')}=[{','.join(many)}]"] if many else overrides


def is_positional(word: str) -> bool:
    """Whether a word is a value without its name: an existing path, or neither assignment nor option."""
    return os.path.exists(word) or ("=" not in word and not word.startswith(("-", "~")))


def quoted(word: str) -> str:
    """A word as a string of Hydra's grammar, whatever is in it; a number that is no path stays one."""
    if re.fullmatch(r"\d+", word) and not os.path.exists(word):
        return word
    word = re.sub(r"(\\*)\$\{", r"\1\1\\${", word)  # `${` begins an interpolation, `\${` does not
    return QuotedString(word, Quote.single).with_quotes()
