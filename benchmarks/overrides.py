"""Random overrides of the configuration, most of them wrong, through the real start of a training.

Run: python benchmarks/overrides.py [--count 1000] [--seed 0] [--verbose]

Each is answered by one line and status 2 before a shape is prepared, or is a training's start; a traceback is
neither. Keys and choices come from the composed config itself, so a new one is tried by itself. Nothing is
prepared or trained: the store hands out made-up shapes, and the trainer stops where it would begin.
"""

import argparse
import contextlib
import io
import os
import random
import sys
import tempfile
import traceback
import warnings
from collections import Counter
from pathlib import Path
from unittest.mock import patch

import numpy as np
import yaml
from hydra import compose, initialize_config_dir
from lightning.pytorch import Trainer

from sdfhub.data.store import store as stores
from sdfhub.settings import flat
from sdfhub.tasks import train as train_task
from sdfhub.tasks.app import register_resolvers
from sdfhub.tasks.build import plain
from sdfhub.tasks.conf_files import configuration_folder

VALUES = [
    *("0", "-1", "1", "2", "3", "0.5", "1e-3", "-0.5", "1e30", "1e400", "nan", "inf", "-inf", "9" * 20),
    *("abc", "''", "' '", "null", "true", "False", "[]", "[1]", "[1,2,3]", "[abc]", "{}", "{a: 1}", "[[1]]"),
    *("'../../x'", "/proc/nowhere", "'a b'", "ä", "1.0", "010", "1_000", "0x10", "-0", "'???'"),
    *("'${nowhere}'", "'${seed}'", "'${oc.env:HOME}'"),
    *("os.system", "sdfhub.errors.SdfhubError", "'{_target_: os.system}'"),
]
"""What a key is set to: numbers at the edges, other types, paths, interpolations, a stranger's code."""


class Started(Exception):
    """A training would begin here."""


class Ball:
    """A prepared shape that is not there."""

    mesh, up, seconds, statistics, center, scale = None, "z", 0.0, {}, np.zeros(3), 1.0

    def __init__(self, id: str):
        self.id, self.category, self.fingerprint = id, "ball", id

    def rows(self, name: str) -> int:
        return 64

    def read(self, name: str, start: int, count: int) -> np.ndarray:
        return np.full((count, 6 if name == "surface" else 4), 0.5, np.float32)

    def read_into(self, rows: np.ndarray, name: str, start: int) -> None:
        rows[:] = 0.5


class Shelf(dict):
    """A store of them."""

    folder, rejected = Path("nowhere"), {}

    def summary(self) -> str:
        return ""


def shelf(source, shapes, *_, **__) -> Shelf:
    """In the place of `store.prepare`."""
    return Shelf({shape.id: Ball(shape.id) for shape in shapes[:1000]})


def started(*_, **__):
    """In the place of `Trainer.fit`."""
    raise Started


def keys_and_groups() -> tuple[list[str], dict[str, list[str]]]:
    """Every leaf of the composed config with all choices of every group, and the groups' choices."""
    folder = configuration_folder()
    defaults = yaml.safe_load((folder / "config.yaml").read_text(encoding="utf-8"))["defaults"]
    own = [group for entry in defaults if isinstance(entry, dict) for group in entry if "/" not in group]
    own = [group.removeprefix("optional ") for group in own]
    groups = {
        group: sorted(path.stem for path in (folder / group).glob("*.yaml"))
        for group in own
        if group not in ("sweeps", "hparams_search")
    }
    keys: dict[str, None] = {}
    with initialize_config_dir(str(folder), version_base="1.3"):
        register_resolvers()
        for group, choices in sorted(groups.items()):
            for choice in choices:
                keys |= dict.fromkeys(flat(plain(compose("config", [f"{group}={choice}"]))))
    return list(keys), groups


def random_override(chance: random.Random, keys: list[str], groups: dict[str, list[str]]) -> list[str]:
    """One to three words of a command line."""
    words = []
    for _ in range(chance.choice([1, 1, 1, 2, 3])):
        kind = chance.random()
        key, group = chance.choice(keys), chance.choice(sorted(groups))
        if kind < 0.65:
            words.append(f"{key}={chance.choice(VALUES)}")
        elif kind < 0.8:
            words.append(f"{group}={chance.choice([*groups[group], 'null', misspelt(chance, group)])}")
        elif kind < 0.9:
            words.append(f"{misspelt(chance, key)}={chance.choice(VALUES)}")
        else:
            odd = [f"+{key}.new=1", f"~{key}", f"++{key}=1", key, f"{key}=", "=1"]
            words.append(chance.choice([*odd, f"+{group}=x", f"~{group}"]))
    return words


def misspelt(chance: random.Random, word: str) -> str:
    """`word` with one letter lost or doubled."""
    at = chance.randrange(len(word))
    return word[:at] + chance.choice(["", 2 * word[at]]) + word[at + 1 :]


def answer(words: list[str], folder: Path) -> tuple[str, str]:
    """How the start of a training with these words ends, and what it says."""
    errors, verdict = io.StringIO(), "returned"
    arguments = ["train.py", f"hydra.run.dir={folder / 'run'}", *words]
    with (
        patch.object(sys, "argv", arguments),
        patch.object(stores, "prepare", shelf),
        patch.object(Trainer, "fit", started),
        contextlib.redirect_stderr(errors),
        contextlib.redirect_stdout(io.StringIO()),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore")
        try:
            train_task.main()
        except Started:
            verdict = "started"
        except SystemExit as stop:
            verdict = "refused" if stop.code == 2 else f"status {stop.code}"
        except BaseException:
            return "traceback", traceback.format_exc()
    told = errors.getvalue().strip()
    if verdict == "refused" and not told.rpartition("\n")[2].startswith("sdfhub: error: "):
        verdict = "unexplained"
    return ("traceback" if "Traceback" in told else verdict), told


def main() -> None:
    """Counts how random overrides end; status 1 where one ends in a traceback or without an explanation."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--verbose", action="store_true", help="print every override and its answer")
    args = parser.parse_args()
    chance, (keys, groups) = random.Random(args.seed), keys_and_groups()
    ends = Counter()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        for number in range(args.count):
            words = random_override(chance, keys, groups)
            verdict, told = answer(words, Path(folder) / str(number))
            ends[verdict] += 1
            if args.verbose or verdict not in ("started", "refused"):
                print(f"{verdict}: {' '.join(words)}\n    {told[-2500:]}", flush=True)
    print(f"{len(keys)} keys, {sum(map(len, groups.values()))} choices; {dict(ends)}")
    sys.exit(int(not set(ends) <= {"started", "refused"}))


if __name__ == "__main__":
    main()
