"""Every promise of docs/reliability.md is held by tests that are there."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "reliability.md").read_text()
ROWS = dict(re.findall(r"^\| (\d+) \| (.*)$", PAGE, re.MULTILINE))


def test_every_promise_is_there():
    assert sorted(map(int, ROWS)) == list(range(1, 23))


@pytest.mark.parametrize("number", ROWS)
def test_a_promise_names_tests_that_are_there(number):
    named = re.findall(r"`(tests/\w+\.py)::(\w+)`", ROWS[number])
    assert named
    for file, test in named:
        found = {node.name for node in ast.parse((ROOT / file).read_text()).body if hasattr(node, "name")}
        assert test in found, f"{file} has no {test}"


def test_commands_name_files_that_are_there():
    for file in re.findall(r"python (benchmarks/\w+\.py)|pytest (tests/\w+\.py)", PAGE):
        assert (ROOT / "".join(file)).is_file()
