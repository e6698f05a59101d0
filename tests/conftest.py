"""What tests of several files ask for."""

from pathlib import Path

import pytest
import torch


@pytest.fixture(params=[2, 3])
def several(request):
    """As many threads for PyTorch."""
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


UNREPAIRED = (Path(__file__).parent / "unrepaired.txt").read_text().split()
"""Tests of before the rebuilding of the rooms that do not pass since: to be repaired."""


def pytest_ignore_collect(collection_path):
    return True if f"tests/{collection_path.name}" in UNREPAIRED else None


def pytest_collection_modifyitems(items):
    for item in items:
        if item.nodeid.partition("[")[0] in UNREPAIRED:
            item.add_marker(
                pytest.mark.skip(reason="unrepaired since the rebuilding; see tests/unrepaired.txt")
            )
