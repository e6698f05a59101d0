"""Plain words of a command line: which ones are positional, and that any path survives Hydra's grammar."""

import doctest

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from sdfhub.tasks import app
from sdfhub.tasks.app import words_to_overrides

PATHS = [
    "a b",
    " a ",
    "a,b",
    "x=y",
    "run=1",
    "it's",
    '"q"',
    "[1]",
    "{a}",
    "日本",
    "null",
    "true",
    "1e3",
    "3",
    "#",
    "%",
    "*",
]
PATHS += [
    "\\",
    "a\\",
    "\\'",
    "\\\\'",
    "C:\\a\\b",
    "$x",
    "${x}",
    "\\${x}",
    "\\\\${x}",
    "a'${y}'\\",
    "-m",
    "~x",
    "a:b",
    "a\nb",
]


def value_of(override: str):
    """A value as a task sees it, after Hydra's parser and OmegaConf."""
    (parsed,) = OverridesParser.create().parse_overrides([override])
    config = OmegaConf.create({parsed.key_or_group: parsed.value()})
    return OmegaConf.to_container(config, resolve=True)[parsed.key_or_group]


@pytest.mark.parametrize("path", PATHS)
def test_a_path_survives_whatever_is_in_it(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / path).mkdir()
    one, many = words_to_overrides([path], ["run"]), words_to_overrides([path, path], ["scans..."])
    assert value_of(*one) == path and value_of(*many) == [path, path]


def test_words_take_their_names_in_order_and_the_rest_is_left_alone(tmp_path):
    assert words_to_overrides(["A", "B", "steps=3"], ["run", "a", "b"]) == ["run='A'", "a='B'", "steps=3"]
    assert words_to_overrides(["run=R", "7", "chairs/0001"], ["run", "a", "b"]) == [
        "run=R",
        "a=7",
        "b='chairs/0001'",
    ]
    assert words_to_overrides(["-m", "R", "--config-dir", "conf", "~x"], ["run"]) == [
        "-m",
        "run='R'",
        "--config-dir",
        "conf",
        "~x",
    ]
    assert words_to_overrides(["R", "S"], ["run"]) == ["run='R'", "S"], "Hydra refuses it"
    assert words_to_overrides(["scans=a.ply", "R", "b.ply"], ["run", "scans..."])[1:] == ["run='R'", "b.ply"]
    assert words_to_overrides([], ["run", "scans..."]) == []
    assert words_to_overrides(["R", "x" * 5000], ["run", "scans..."])[1].startswith("scans=['xx")


def test_the_example_runs():
    failed, tried = doctest.testmod(app)
    assert tried and not failed
