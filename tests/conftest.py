"""What tests of several files ask for."""

import pytest
import torch


@pytest.fixture(params=[2, 3])
def several(request):
    """As many threads for PyTorch."""
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)
