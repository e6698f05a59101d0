"""The shell around every task: Hydra composes, the task runs, a user's mistake becomes one line."""

import inspect
import os
import re
import sys
import uuid
import warnings
from collections.abc import Callable
from difflib import get_close_matches
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

import sdfhub
from sdfhub.errors import SdfhubError
from sdfhub.tasks.names import cell_name, run_name, run_stamp, search_digest, sweep_name
from sdfhub.tasks.search import trials_done, trials_left


def configuration_folder() -> Path:
    """The folder of YAMLs: inside an installed package, beside `src/` in a checkout."""
    package = Path(sdfhub.__file__).resolve().parent
    inside = package / "conf"
    return inside if inside.is_dir() else package.parents[1] / "conf"


def register_resolvers() -> None:
    """Makes the functions that configs call known to them, here or in a launcher's worker."""
    # conf/hydra has the names that users know, which are the plugins' own; Hydra warns of that each time
    warnings.filterwarnings("ignore", r"\s*'hydra/.*is validated against ConfigStore schema")
    for name in (run_name, run_stamp, search_digest, sweep_name, cell_name, trials_done, trials_left):
        OmegaConf.register_new_resolver(name.__name__, name, replace=True)
    OmegaConf.register_new_resolver("oc.env", _refuse_environment, replace=True)
    # two runs that start in one second must not share a folder
    OmegaConf.register_new_resolver("unique", lambda: uuid.uuid4().hex[:4], use_cache=True, replace=True)


def _refuse_environment(name: str, *_: str) -> None:
    # a run's settings are written down and passed on, and the environment holds keys and passwords
    raise SdfhubError(f"${{oc.env:{name}}}: settings are not taken from the environment; write the value")


def run_task(task: Callable[[DictConfig], float | None], config_name: str) -> None:
    """Composes `config_name` with the command line's overrides and runs `task` on it.

    What a task returns is what a search lowers.

    A cell of a multirun that fails does not stop the others. Exit status: 0, 2 after a user's mistake (one
    line on stderr, no traceback), 130 after Ctrl-C. HYDRA_FULL_ERROR=1 in the environment shows tracebacks.
    """
    if {"-h", "--help"} & set(sys.argv[1:]) and config_name != "config":
        print(help_of(config_name))
        return
    failures: list[Exception] = []
    composed = False
    verbose, here = os.environ.get("HYDRA_FULL_ERROR") == "1", os.getpid()
    register_resolvers()

    def guarded(config: DictConfig) -> float | None:
        nonlocal composed
        composed = True
        try:
            refuse_multirun_words(HydraConfig.get())
            refuse_strangers(config, config_name, HydraConfig.get())
            return task(config)
        except (SdfhubError, OmegaConfBaseException, OSError) as error:
            if verbose:
                raise
            if os.getpid() != here:  # a launcher's worker: only what is raised finds its way home
                raise SdfhubError(one_line(error, config_name)) from None
            failures.append(error)
        return None

    app = hydra.main(version_base="1.3", config_path=str(configuration_folder()), config_name=config_name)(
        guarded
    )
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
        if verbose or (composed and not told):  # what Hydra makes of a command line may raise anything
            raise
        failures.append(error)
    finally:
        os.environ["HYDRA_FULL_ERROR"] = str(int(verbose))
    for error in failures:
        print(f"sdfhub: error: {one_line(error, config_name)}", file=sys.stderr)
    if failures:
        sys.exit(2)


def help_of(config_name: str) -> str:
    """What a task can be given: its YAML and those of its groups, whose comments say what each key is."""
    parts = [_told_by(configuration_folder() / f"{config_name}.yaml")]
    if "config" in _yaml(configuration_folder() / f"{config_name}.yaml")["defaults"]:
        return parts[0] + "\n\n# and every group and key of a training: python train.py --help"
    for group, chosen in _composed_groups(config_name).items():
        choices = ", ".join(sorted(path.stem for path in (configuration_folder() / group).glob("*.yaml")))
        parts.append(f"{group}: {'null' if chosen is None else chosen} # one of {choices}")
        if chosen is not None:
            own = _told_by(configuration_folder() / group / f"{chosen}.yaml")
            parts[-1] += "\n" + "\n".join(f"  {line}".rstrip() for line in own.splitlines())
    return "\n\n".join(parts)


def _told_by(path: Path) -> str:
    """The text of a YAML less what is not for a user: the defaults list, Hydra's own keys, classes."""
    text = path.read_text(encoding="utf-8")
    text = re.sub(r"^(defaults|hydra):\n(?:[ ].*\n?|\n)*", "", text, flags=re.MULTILINE)
    return re.sub(r"^ *(_target_|_partial_|# @package).*\n", "", text, flags=re.MULTILINE).rstrip()


def first_word_as(key: str) -> None:
    """Lets the command line's first word stand for a path: `sdfhub report DIR` for `... sweep=DIR`."""
    first = sys.argv[1] if len(sys.argv) > 1 else "-"
    if Path(first).is_dir() or (not first.startswith("-") and "=" not in first):
        quoted = first.replace("\\", "\\\\").replace("'", "\\'")
        sys.argv[1] = f"{key}='{quoted}'"  # quoted, so that Hydra takes any path as text


def told_by_plugin(error: Exception) -> SdfhubError | None:
    """What a user needs of a failure of a launcher or a search; None where it is none of theirs."""
    plugin = type(error).__module__.partition(".")[0]
    if plugin in ("joblib", "submitit"):
        reason = [type(error).__name__, *str(error).strip().splitlines()][-1]
        return SdfhubError(f"{plugin}: a worker died: {reason}; the same command goes on from there")
    if str(error).startswith(("No trials are completed", "Record does not exist")):  # Optuna's best of none
        return SdfhubError("search: not one training came to its end; see failed.json in their folders")
    return None


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
    read = [_yaml(configuration_folder() / f"{name}.yaml") for name in ("config", config_name)]
    for key in config:
        if key not in {*_groups(), *read[0], *read[1]}:
            raise SdfhubError(_no_such_key(str(key), config_name))
    node = {key: value for key, value in read[1].items() if key not in ("defaults", "hydra")}
    there = {*_leaves(OmegaConf.to_container(config, resolve=False)), *hydra.runtime.choices}
    groups = [group for group, choice in _composed_groups(config_name).items() if choice and " " not in group]
    for key in (*groups, *_leaves(node)):
        if key not in there:
            raise SdfhubError(f"{key}: is needed; do not leave it out")


def one_line(error: Exception, config_name: str = "config") -> str:
    """What a user needs of an error: what is wrong and, for a wrong choice, the choices of that config."""
    if isinstance(error, OSError) and error.filename:
        return f"{error.filename}: {(error.strerror or 'cannot be used').lower()}"
    text = re.sub(r"\s+", " ", str(error)).strip() or type(error).__name__
    text = text.split(" Config search path:")[0].split(" full_key:")[0].split(" See https://hydra.cc")[0]
    if "hydra/sweeper/optuna'" in text:
        return "search: needs Optuna; pip install 'sdfhub[optuna]'"
    if "hydra/launcher/ray'" in text:
        return "hydra/launcher=ray: is not installed here; pip install hydra-ray-launcher"
    if text.startswith("Config group override must be"):
        return "a group takes the name of one of its choices; ~GROUP leaves out one like tuned"
    if text.startswith("Ambiguous value"):
        return f"{text} To train one after another, add -m."
    if text.startswith("Error resolving interpolation '${scale}_"):
        return "scale, decoder, activation and encoding: are needed; do not leave one out"
    unknown = re.match(r"Could not override '([^']+)'", text)
    missing = re.match(r"Missing mandatory value: (\S+)", text)
    if missing:
        return f"{missing.group(1)}=...: must be given"
    choice = re.search(r"Could not find '[^']+/([^'/]+)' Available options in '[^']+': (.+)", text)
    if choice and (near := get_close_matches(choice.group(1), choice.group(2).split(), n=1)):
        return f"{text}; did you mean {near[0]!r}?"
    return _no_such_key(unknown.group(1), config_name) if unknown else text


def _no_such_key(key: str, config_name: str = "config") -> str:
    group, _, below = key.partition(".")
    groups = _groups()
    if group == "hydra":
        return f"there is no key {key!r}; {_hydra_hint(key)}"
    if group == "trainer" and below in _trainer_arguments():
        return f"{key}: conf/ does not set it; write +{key}=..."
    if below and group in groups:
        keys = _keys_of(group)
        near = get_close_matches(key, keys, n=1, cutoff=0.85)
        hint = f"did you mean {near[0]!r}?" if near else f"{group} sets {', '.join(keys)}"
        return f"there is no key {key!r}; {hint}"
    own = [] if config_name == "config" else _top_level_keys(config_name)
    near = get_close_matches(key, own or [*groups, *_top_level_keys("config")], n=1)
    choices = f"the keys are {', '.join(own)}" if own else f"the groups are {', '.join(groups)}"
    hint = f"did you mean {near[0]!r}?" if near else choices
    return f"there is no group or key {key!r}; {hint}"


def _hydra_hint(key: str) -> str:
    """Where there would be such a key of Hydra's own part: most are those of a launcher."""
    owners: dict[str, list[str]] = {}
    for path in sorted((configuration_folder() / "hydra" / "launcher").glob("*.yaml")):
        for leaf in _leaves(_yaml(path)):
            owners.setdefault(f"hydra.launcher.{leaf}", []).append(f"hydra/launcher={path.stem}")
    if key in owners:
        return f"add {' or '.join(owners[key])}, which has it"
    near = get_close_matches(key, owners, n=1, cutoff=0.85)
    if near:
        return f"did you mean {near[0]!r} of {' or '.join(owners[near[0]])}?"
    return "--cfg hydra shows those that there are"


def _trainer_arguments() -> list[str]:
    """What Lightning's Trainer takes."""
    from lightning.pytorch import Trainer  # here: it takes seconds to import

    return list(inspect.signature(Trainer).parameters)


def _top_level_keys(config_name: str) -> list[str]:
    """What a task's own config can be given: its keys and the groups that it composes."""
    node = _yaml(configuration_folder() / f"{config_name}.yaml")
    keys = [key for key in node if key not in ("defaults", "hydra")]
    return list(dict.fromkeys([*keys, *_composed_groups(config_name)]))


def _composed_groups(config_name: str) -> dict[str, str | None]:
    """The groups of a task's own config and what it takes of them; `config` brings a training's."""
    defaults = _yaml(configuration_folder() / f"{config_name}.yaml")["defaults"]
    composed = {
        group: choice for entry in defaults if isinstance(entry, dict) for group, choice in entry.items()
    }
    return {
        name.removeprefix("override "): chosen for name, chosen in composed.items() if "hydra" not in name
    }


def _groups() -> list[str]:
    return sorted(folder.name for folder in configuration_folder().iterdir() if folder.is_dir())


def _keys_of(group: str) -> list[str]:
    """Dotted keys that the choices of a group set, where they lie: those of `fit` below `evaluate.fit`."""
    found = {
        f"{group}.{key}": None
        for key in _leaves(_yaml(configuration_folder() / "config.yaml").get(group, {}))
    }
    for path in sorted((configuration_folder() / group).glob("*.yaml")):
        named = re.match(r"# @package (\S+)", path.read_text(encoding="utf-8"))
        package = named.group(1) if named else group
        prefix = "" if package == "_global_" else f"{package}."
        found |= {f"{prefix}{key}": None for key in _leaves(_yaml(path))}
    unset = ("_target_", "_partial_", "defaults")
    found = [key for key in found if not key.endswith(unset) and not key.startswith("hydra.")]
    own = [key for key in found if key.startswith(f"{group}.")]  # a scale sets much that is not its own
    return own or found


def _leaves(node: dict, prefix: str = "") -> list[str]:
    pairs = [(f"{prefix}{key}", value) for key, value in node.items()]
    return [
        leaf
        for key, value in pairs
        for leaf in (_leaves(value, key + ".") if isinstance(value, dict) else [key])
    ]


def _yaml(path: Path) -> dict:
    return OmegaConf.to_container(OmegaConf.load(path), resolve=False)
