"""The shell around every task: Hydra composes, objects are made once, a user's mistake becomes one line."""

import os
import sys
from collections.abc import Callable, Sequence

import hydra
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from sdfhub.composition import configuration_folder, one_line
from sdfhub.errors import SdfhubError
from sdfhub.multirun.names import register_resolvers
from sdfhub.tasks.words import words_to_overrides

Task = Callable[[DictConfig], float | None]
"""What a command does with its composed config; a search lowers what is returned."""


def run_task(task: Task, config_name: str, positional: Sequence[str] = ()) -> None:
    """Composes `config_name` with the words of the command line and runs `task` on it.

    Exit status: 0, 2 after a user's mistake (one line on stderr, no traceback), 130 after Ctrl-C; 1 where
    Hydra refuses the command line. HYDRA_FULL_ERROR=1 in the environment shows tracebacks.
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
