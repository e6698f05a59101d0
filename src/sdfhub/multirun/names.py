"""Names of folders: of a run, of a multirun, and of its cells, which are found again by name."""

import os
import re
import uuid
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from sdfhub.multirun.search import trials_done, trials_left
from sdfhub.settings import deciding, settings_digest

NAMED_GROUPS = ("data", "category", "experiment", "activation", "encoding", "normals", "decoder", "scale")


def register_resolvers() -> None:
    """Makes the functions that conf/ calls known to OmegaConf, here or in a launcher's worker."""
    for resolver in (run_name, run_stamp, sweep_name, cell_name, trials_done, trials_left, eighth):
        OmegaConf.register_new_resolver(resolver.__name__, resolver, replace=True)
    # Hydra hands cached values on from a multirun to its cells: `once` gives them all one folder
    OmegaConf.register_new_resolver("once", lambda value: value, use_cache=True, replace=True)
    # two runs that start in one second must not share a folder
    OmegaConf.register_new_resolver("unique", lambda: uuid.uuid4().hex[:4], use_cache=True, replace=True)


def eighth(count: object) -> int:
    """An eighth of a count, at least 1; 1 of what is no count."""
    return max(1, count // 8) if isinstance(count, int) else 1


def run_name(*, _root_: DictConfig, groups: Sequence[str] = NAMED_GROUPS) -> str:
    """Folder name of a run from the choices that tell it from others: `procedural_chairs_hosc_...`."""
    choices = choices_of(_root_, _root_.hydra)
    words = [("normals-" if g == "normals" else "") + choices[g] for g in groups if g in choices]
    return "_".join(re.sub(r"[^\w.-]+", "-", word) for word in words)


def run_stamp(otherwise: str, *, _root_: DictConfig) -> str:
    """What tells runs of one name apart: `otherwise`; under SLURM what a requeued job keeps."""
    job = os.environ.get("SLURM_JOB_ID")
    return f"slurm-{job}_{_digest(_root_)}" if job else otherwise


def sweep_name(otherwise: str, *, _root_: DictConfig) -> str:
    """Folder name of a multirun, where its command finds its cells again; `otherwise` without a sweep."""
    choices = _root_.hydra.runtime.choices
    if choices.get("hparams_search"):
        name = run_name(_root_=_root_, groups=("hparams_search", "data", "category", "scale"))
        return f"search_{name}_{_digest(_root_)}"  # the objectives of its trainings are compared
    return choices.get("sweeps") or otherwise


def cell_name(*, _root_: DictConfig) -> str:
    """Folder name of a cell: its choices, its seed, and a digest of all its settings."""
    return f"{run_name(_root_=_root_)}_seed-{_root_.seed}_{_digest(_root_)}"


def choices_of(config: DictConfig, hydra: DictConfig) -> dict[str, str]:
    """The choice of each group; shapes of a source without categories are called by its folder."""
    choices = hydra.runtime.choices.items()
    choices = {group: str(choice) for group, choice in choices if choice and "/" not in group}
    source: Any = OmegaConf.select(config, "data.source") or {}
    if source.get("root") and not source.get("categories"):
        choices["category"] = Path(source.root).resolve().name
    return choices


def _digest(root: DictConfig) -> str:
    """The digest of a composed config; `${hydra:...}`, which only a started job knows, counts as written."""
    written: Any = OmegaConf.to_container(root, resolve=False)
    del written["hydra"]
    settings = deciding(written)
    for key, text in settings.items():
        if "${" in str(text):
            with suppress(OmegaConfBaseException, ValueError):
                settings[key] = OmegaConf.select(root, key)
    return settings_digest(settings)
