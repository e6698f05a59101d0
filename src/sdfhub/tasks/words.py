"""Plain words of a command line, such as `sdfhub reconstruct RUN scan.ply`, as Hydra's overrides."""

import re
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

TAKES_A_VALUE = ("--config-path", "-cp", "--config-name", "-cn", "--config-dir", "-cd", "--package", "-p")
"""Hydra's options whose value is the next word."""


def words_to_overrides(argv: Sequence[str], names: Sequence[str]) -> list[str]:
    """A command line's words, in which positional ones have become `name=value`.

    Names that the line also gives as `name=value` are left out; the last may end with `...` and takes any
    number of words. Words beyond the names stay as they are, for Hydra to refuse.

    >>> words_to_overrides(["my run", "a.ply", "b,c.ply", "frame=unknown"], ["run", "scans..."])
    ["run='my run'", 'frame=unknown', "scans=['a.ply','b,c.ply']"]
    """
    given = {word.partition("=")[0] for word in argv if not is_positional(word)}
    left = [name for name in names if name.removesuffix("...") not in given]
    overrides: list[str] = []
    many: list[str] = []
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
    with suppress(OSError, ValueError):  # longer than a name may be, or with a NUL
        if word and Path(word).exists():
            return True
    return "=" not in word and not word.startswith(("-", "~"))


def quoted(word: str) -> str:
    """A word as a string of Hydra's grammar, whatever is in it; a number that is no path stays one.

    In quotes a backslash counts only before a quote, and `${` begins an interpolation, which `\\${` does not.
    """
    if re.fullmatch(r"\d+", word) and not Path(word).exists():
        return word
    word = re.sub(r"(\\*)\$\{", r"\1\1\\${", word)
    word = re.sub(r"(\\*)'", r"\1\1\\'", word)
    return "'" + re.sub(r"(\\+)$", r"\1\1", word) + "'"
