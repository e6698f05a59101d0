"""Names of folders: of a run, of a sweep, and of a sweep's cell, which are found again by name."""

import os
from typing import Any

from omegaconf import DictConfig, OmegaConf

from sdfhub.settings import WHERE_NOT_WHAT, settings_digest

NAMED_CHOICES = ("data", "category", "experiment", "activation", "encoding", "normals", "decoder", "scale")

OF_A_ROW = ("activation", "encoding", "normals", "decoder", "conditioning", "optim", "codes", "loss", "scale")
"""Parts of a config that the rows of a table differ in."""


def run_name(*, _root_: DictConfig) -> str:
    """Folder name of a run from the choices that tell it from others: `procedural_chairs_hosc_...`."""
    return _joined(_root_.hydra.runtime.choices)


def run_stamp(otherwise: str, *, _root_: DictConfig) -> str:
    """What tells a run's folder from others: under SLURM its job and settings, else `otherwise`.

    A job that SLURM puts back into the queue finds its folder again and goes on.
    """
    job = os.environ.get("SLURM_JOB_ID")
    return f"slurm-{job}_{_digest_of(_root_)}" if job else otherwise


def sweep_name(otherwise: str, *, _root_: DictConfig) -> str:
    """Folder name of a multirun: the sweep's own name, so that the same command finds its cells again.

    That of a search has a digest of the settings that all its trainings share: their objectives are compared.
    """
    choices = _root_.hydra.runtime.choices
    if choices.get("search"):
        named = [choices[name] for name in ("search", "data", "category", "scale")]
        return "_".join(["search", *named, search_digest(_root_=_root_)])
    return choices.get("sweeps") or otherwise


def search_digest(*, _root_: DictConfig) -> str:
    """What tells a search from others: its own trainings, whose settings differ, hear it from `search.of`.

    What the row decides, which the search's own config does not know yet, counts where the command line sets
    it: a search is not lost when another row's defaults change.
    """
    if _root_.search.of:
        return _root_.search.of
    return f"of-{_digest_of(_root_, leave=OF_A_ROW)}"


def cell_name(*, _root_: DictConfig) -> str:
    """Folder name of a cell: its choices, its seed, and a digest of all its settings."""
    return f"{_joined(_root_.hydra.runtime.choices)}_seed-{_root_.seed}_{_digest_of(_root_)}"


def _digest_of(root: DictConfig, leave: tuple[str, ...] = ()) -> str:
    """The digest of a composed config; parts to `leave` count where the command line sets them."""
    settings = OmegaConf.masked_copy(root, [key for key in root if key != "hydra"])
    said = [word.lstrip("+~") for word in root.hydra.overrides.task]
    try:
        settings = OmegaConf.to_container(settings, resolve=True)
    except Exception:  # a broken interpolation is that run's own failure, to be told when it starts
        return settings_digest({"overrides": said})
    kept = {key: part for key, part in settings.items() if key not in leave}
    if leave:
        kept["overrides"] = sorted(word for word in said if not word.startswith(WHERE_NOT_WHAT))
    return settings_digest(kept)


def _joined(choices: Any) -> str:
    parts = [
        f"{group}-{choices[group]}" if group == "normals" else choices.get(group) for group in NAMED_CHOICES
    ]
    return "_".join(part for part in parts if part)
