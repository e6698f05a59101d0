"""What a user reads: one line for each mistake, and the help of a task."""

import inspect
import re
from difflib import get_close_matches
from pathlib import Path

from sdfhub.errors import SdfhubError
from sdfhub.tasks.conf_files import (
    composed_groups,
    configuration_folder,
    group_names,
    keys_of,
    leaves,
    read_yaml,
    top_level_keys,
)


def one_line(error: Exception, config_name: str = "config") -> str:
    """What a user needs of an error: what is wrong and, for a wrong choice, the choices of that config."""
    if isinstance(error, OSError) and error.filename:
        return f"{error.filename}: {(error.strerror or 'cannot be used').lower()}"
    text = re.sub(r"\s+", " ", str(error)).strip() or type(error).__name__
    text = text.split(" Config search path:")[0].split(" full_key:")[0].split(" See https://hydra.cc")[0]
    if isinstance(error, SdfhubError):  # worded already, perhaps in another process
        return text
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
    return no_such_key(unknown.group(1), config_name) if unknown else text


def told_by_plugin(error: Exception) -> SdfhubError | None:
    """What a user needs of a failure of a launcher or a search; None where it is none of theirs."""
    plugin = type(error).__module__.partition(".")[0]
    if plugin in ("joblib", "submitit"):
        reason = [type(error).__name__, *str(error).strip().splitlines()][-1]
        return SdfhubError(f"{plugin}: a worker died: {reason}; the same command goes on from there")
    if str(error).startswith(("No trials are completed", "Record does not exist")):  # Optuna's best of none
        return SdfhubError("search: not one training came to its end; see failed.json in their folders")
    return None


def help_of(config_name: str) -> str:
    """What a task can be given: its YAML and those of its groups, whose comments say what each key is."""
    parts = [_told_by(configuration_folder() / f"{config_name}.yaml")]
    if "config" in read_yaml(configuration_folder() / f"{config_name}.yaml")["defaults"]:
        return parts[0] + "\n\n# and every group and key of a training: python train.py --help"
    for group, chosen in composed_groups(config_name).items():
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


def no_such_key(key: str, config_name: str = "config") -> str:
    """That there is no such key, and which one may have been meant."""
    group, _, below = key.partition(".")
    groups = group_names()
    if group == "hydra":
        return f"there is no key {key!r}; {_hydra_hint(key)}"
    if group == "trainer" and below in _trainer_arguments():
        return f"{key}: conf/ does not set it; write +{key}=..."
    if below and group in groups:
        keys = keys_of(group)
        near = get_close_matches(key, keys, n=1, cutoff=0.85)
        hint = f"did you mean {near[0]!r}?" if near else f"{group} sets {', '.join(keys)}"
        return f"there is no key {key!r}; {hint}"
    own = [] if config_name == "config" else top_level_keys(config_name)
    near = get_close_matches(key, own or [*groups, *top_level_keys("config")], n=1)
    choices = f"the keys are {', '.join(own)}" if own else f"the groups are {', '.join(groups)}"
    hint = f"did you mean {near[0]!r}?" if near else choices
    return f"there is no group or key {key!r}; {hint}"


def _hydra_hint(key: str) -> str:
    """Where there would be such a key of Hydra's own part: most are those of a launcher."""
    owners: dict[str, list[str]] = {}
    for path in sorted((configuration_folder() / "hydra" / "launcher").glob("*.yaml")):
        for leaf in leaves(read_yaml(path)):
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
