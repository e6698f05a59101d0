"""What the YAMLs of conf/ hold, read as files: their groups, keys and choices."""

import re
from pathlib import Path

from omegaconf import OmegaConf

import sdfhub


def configuration_folder() -> Path:
    """The folder of YAMLs: inside an installed package, beside `src/` in a checkout."""
    package = Path(sdfhub.__file__).resolve().parent
    inside = package / "conf"
    return inside if inside.is_dir() else package.parents[1] / "conf"


def group_names() -> list[str]:
    """The folders of conf/."""
    return sorted(folder.name for folder in configuration_folder().iterdir() if folder.is_dir())


def keys_of(group: str) -> list[str]:
    """Dotted keys that the choices of a group set, where they lie: those of `fit` below `evaluate.fit`."""
    found = {
        f"{group}.{key}": None
        for key in leaves(read_yaml(configuration_folder() / "config.yaml").get(group, {}))
    }
    for path in sorted((configuration_folder() / group).glob("*.yaml")):
        named = re.match(r"# @package (\S+)", path.read_text(encoding="utf-8"))
        package = named.group(1) if named else group
        prefix = "" if package == "_global_" else f"{package}."
        found |= {f"{prefix}{key}": None for key in leaves(read_yaml(path))}
    unset = ("_target_", "_partial_", "defaults")
    found = [key for key in found if not key.endswith(unset) and not key.startswith("hydra.")]
    own = [key for key in found if key.startswith(f"{group}.")]  # a scale sets much that is not its own
    return own or found


def top_level_keys(config_name: str) -> list[str]:
    """What a task's own config can be given: its keys and the groups that it composes."""
    node = read_yaml(configuration_folder() / f"{config_name}.yaml")
    keys = [key for key in node if key not in ("defaults", "hydra")]
    return list(dict.fromkeys([*keys, *composed_groups(config_name)]))


def composed_groups(config_name: str) -> dict[str, str | None]:
    """The groups of a task's own config and what it takes of them; `config` brings a training's."""
    defaults = read_yaml(configuration_folder() / f"{config_name}.yaml")["defaults"]
    composed = {
        group: choice for entry in defaults if isinstance(entry, dict) for group, choice in entry.items()
    }
    return {
        name.removeprefix("override "): chosen for name, chosen in composed.items() if "hydra" not in name
    }


def leaves(node: dict, prefix: str = "") -> list[str]:
    """Dotted keys of all that is no mapping in a nested one."""
    pairs = [(f"{prefix}{key}", value) for key, value in node.items()]
    return [
        leaf
        for key, value in pairs
        for leaf in (leaves(value, key + ".") if isinstance(value, dict) else [key])
    ]


def read_yaml(path: Path) -> dict:
    """A YAML as plain data, its interpolations as they are written."""
    return OmegaConf.to_container(OmegaConf.load(path), resolve=False)
