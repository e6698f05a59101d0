"""The shell around every task: Hydra composes, the task runs, a user's mistake becomes one line."""

import os
import re
import sys
import uuid
from collections.abc import Callable
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

import sdfhub
from sdfhub.errors import SdfhubError

NAMED_CHOICES = ("data", "category", "experiment", "activation", "encoding", "normals", "decoder", "scale")


def configuration_folder() -> Path:
    """The folder of YAMLs: inside an installed package, beside `src/` in a checkout."""
    package = Path(sdfhub.__file__).resolve().parent
    inside = package / "conf"
    return inside if inside.is_dir() else package.parents[1] / "conf"


def run_name() -> str:
    """Folder name of a run from the choices that tell it from others: `procedural_chairs_hosc_...`."""
    choices = HydraConfig.get().runtime.choices
    parts = [
        f"{group}-{choices[group]}" if group == "normals" else choices.get(group) for group in NAMED_CHOICES
    ]
    return "_".join(part for part in parts if part)


def register_resolvers() -> None:
    """Makes `${run_name:}` and `${unique:}` known to the configs."""
    OmegaConf.register_new_resolver("run_name", run_name, replace=True)
    # two runs that start in one second must not share a folder
    OmegaConf.register_new_resolver("unique", lambda: uuid.uuid4().hex[:4], use_cache=True, replace=True)


def run_task(task: Callable[[DictConfig], None], config_name: str) -> None:
    """Composes `config_name` with the command line's overrides and runs `task` on it.

    A cell of a multirun that fails does not stop the others. Exit status: 0, 2 after a user's mistake (one
    line on stderr, no traceback), 130 after Ctrl-C. HYDRA_FULL_ERROR=1 in the environment shows tracebacks.
    """
    failures: list[Exception] = []
    verbose = os.environ.get("HYDRA_FULL_ERROR") == "1"
    register_resolvers()

    def guarded(config: DictConfig) -> None:
        try:
            task(config)
        except (SdfhubError, OmegaConfBaseException) as error:
            if verbose:
                raise
            failures.append(error)

    app = hydra.main(version_base="1.3", config_path=str(configuration_folder()), config_name=config_name)(
        guarded
    )
    os.environ["HYDRA_FULL_ERROR"] = "1"  # else Hydra prints composition errors itself, in its own words
    try:
        app()
    except (HydraException, OmegaConfBaseException) as error:
        if verbose:
            raise
        failures.append(error)
    except KeyboardInterrupt:
        sys.exit(130)
    finally:
        os.environ["HYDRA_FULL_ERROR"] = str(int(verbose))
    for error in failures:
        print(f"sdfhub: error: {one_line(error)}", file=sys.stderr)
    if failures:
        sys.exit(2)


def one_line(error: Exception) -> str:
    """What a user needs of an error message: its first statements and, for a wrong choice, the choices."""
    text = str(error) or type(error).__name__
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    told = [
        line for line in lines if not re.match(r"(full_key|object_type|reference_type|Set the env)", line)
    ]
    return re.sub(r"\s+", " ", " ".join(told))
