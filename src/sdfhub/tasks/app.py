"""The shell around every task: Hydra composes, the task runs, a user's mistake becomes one line."""

import os
import re
import sys
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from sdfhub.errors import SdfhubError
from sdfhub.multirun.names import register_resolvers
from sdfhub.tasks.conf_files import composed_groups, configuration_folder, group_names, leaves, read_yaml
from sdfhub.tasks.wording import help_of, no_such_key, one_line, told_by_plugin


def run_task(task: Callable[[DictConfig], float | None], config_name: str) -> None:
    """Composes `config_name` with the command line's overrides and runs `task` on it.

    What a task returns is what a search lowers.

    A cell of a multirun that fails does not stop the others. Exit status: 0, 2 after a user's mistake (one
    line on stderr, no traceback), 130 after Ctrl-C. HYDRA_FULL_ERROR=1 in the environment shows tracebacks.
    """
    if {"-h", "--help"} & set(sys.argv[1:]) and config_name != "config":
        print(help_of(config_name))
        return
    # conf/hydra has the names that users know, which are the plugins' own; Hydra warns of that each time
    warnings.filterwarnings("ignore", r"\s*'hydra/.*is validated against ConfigStore schema")
    register_resolvers()
    guard = Guard(task, config_name)

    def guarded(config: DictConfig) -> float | None:  # Hydra asks a function for its file
        return guard(config)

    conf = str(configuration_folder())
    guard.run(hydra.main(version_base="1.3", config_path=conf, config_name=config_name)(guarded))
    for error in guard.failures:
        print(f"sdfhub: error: {one_line(error, config_name)}", file=sys.stderr)
    if guard.failures:
        sys.exit(2)


@dataclass
class Guard:
    """Keeps what a user has to be told until all cells of a command are done.

    Args:
        task: given each composed config.
        config_name: of the task.
    """

    task: Callable[[DictConfig], float | None]
    config_name: str
    failures: list[Exception] = field(default_factory=list)
    verbose: bool = field(default_factory=lambda: os.environ.get("HYDRA_FULL_ERROR") == "1")
    process: int = field(default_factory=os.getpid)
    composed: bool = False

    def __call__(self, config: DictConfig) -> float | None:
        self.composed = True
        try:
            refuse_multirun_words(HydraConfig.get())
            refuse_strangers(config, self.config_name, HydraConfig.get())
            return self.task(config)
        except (SdfhubError, OmegaConfBaseException, OSError) as error:
            if self.verbose:
                raise
            if os.getpid() != self.process:  # a launcher's worker: only what is raised finds its way home
                raise SdfhubError(one_line(error, self.config_name)) from None
            self.failures.append(error)
        return None

    def run(self, app: Callable[[], None]) -> None:
        """Runs Hydra's app; raises what is no user's mistake."""
        os.environ["HYDRA_FULL_ERROR"] = "1"  # else Hydra prints composition errors itself, in its own words
        try:
            app()
        except BrokenPipeError:  # `--help | head`
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            sys.exit(1)
        except KeyboardInterrupt:
            print("sdfhub: interrupted", file=sys.stderr)
            sys.exit(130)
        except Exception as error:
            error = told_by_plugin(error) or error
            told = isinstance(error, SdfhubError | HydraException | OmegaConfBaseException | OSError)
            if self.verbose or (self.composed and not told):  # what Hydra makes of a line may raise anything
                raise
            self.failures.append(error)
        finally:
            os.environ["HYDRA_FULL_ERROR"] = str(int(self.verbose))


def first_word_as(key: str) -> None:
    """Lets the command line's first word stand for a path: `sdfhub report DIR` for `... sweep=DIR`."""
    first = sys.argv[1] if len(sys.argv) > 1 else "-"
    if Path(first).is_dir() or (not first.startswith("-") and "=" not in first):
        quoted = first.replace("\\", "\\\\").replace("'", "\\'")
        sys.argv[1] = f"{key}='{quoted}'"  # quoted, so that Hydra takes any path as text


def refuse_multirun_words(hydra: DictConfig) -> None:
    """Refuses a launcher or a sweeper where there is one run: Hydra would take no notice of it.

    Args:
        hydra: Hydra's own part of a config.

    Raises:
        SdfhubError: names the word.
    """
    if hydra.mode == RunMode.MULTIRUN:
        return
    for word in hydra.overrides.hydra:
        if re.match(r"\+*hydra[/.](launcher|sweeper)\b", word):
            raise SdfhubError(f"{word}: needs -m")


def refuse_strangers(config: DictConfig, config_name: str, hydra: DictConfig) -> None:
    """Refuses top-level keys that nothing reads, such as `+sweep=...`, and to go without those that are read.

    Args:
        config: composed; Hydra's own part may be in it.
        config_name: of the task.
        hydra: Hydra's own part.

    Raises:
        SdfhubError: names the key.
    """
    read = [read_yaml(configuration_folder() / f"{name}.yaml") for name in ("config", config_name)]
    for key in config:
        if key not in {*group_names(), *read[0], *read[1]}:
            raise SdfhubError(no_such_key(str(key), config_name))
    node = {key: value for key, value in read[1].items() if key not in ("defaults", "hydra")}
    there = {*leaves(OmegaConf.to_container(config, resolve=False)), *hydra.runtime.choices}
    groups = [group for group, choice in composed_groups(config_name).items() if choice and " " not in group]
    for key in (*groups, *leaves(node)):
        if key not in there:
            raise SdfhubError(f"{key}: is needed; do not leave it out")
