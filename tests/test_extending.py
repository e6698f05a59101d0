"""The code of docs/extending.md runs, and its rivals train."""

import re
import sys
from functools import partial
from pathlib import Path
from types import ModuleType

import pytest
import torch

from sdfhub.model.losses import Loss
from sdfhub.model.optimisers import Optimisation
from tests.test_model import small_decoder

DOC = (Path(__file__).parents[1] / "docs" / "extending.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def mypkg():
    """A module of all the code blocks, executed in order; those that check derivatives do."""
    module = ModuleType("mypkg")
    sys.modules["mypkg"] = module
    for block in re.findall(r"```python\n(.*?)```", DOC, flags=re.DOTALL):
        exec(block, module.__dict__)
    yield module
    del sys.modules["mypkg"]


def test_an_activation_takes_ten_lines_and_an_encoding_twenty(mypkg):
    for name, most in (("Snake", 10), ("Shells", 20)):
        block = next(
            block for block in re.findall(r"```python\n(.*?)```", DOC, re.DOTALL) if f"class {name}" in block
        )
        lines = [line for line in block.splitlines() if line.strip() and not line.strip().startswith("#")]
        assert len(lines) <= most


def test_the_rivals_of_the_documentation_train_together(mypkg):
    decoder = small_decoder(
        partial(mypkg.Snake, a=2.0), mypkg.Shells(8, 0.1), conditioning=mypkg.Gated, weight_norm=False
    )
    loss, codes = mypkg.Huber(delta=0.1, lambda_code=1e-4), torch.nn.Parameter(torch.randn(2, 4) / 2)
    assert isinstance(loss, Loss) and not loss.wants_gradients(0.5)
    optimisation = Optimisation(
        1e-2, 1e-2, mypkg.Linear(0.1), optimizer=partial(torch.optim.AdamW, weight_decay=0.01)
    )
    optimizer, schedule = optimisation.configure(decoder.parameters(), [codes], steps=60)
    points = torch.rand(2, 200, 3) - 0.5
    target = points.norm(dim=-1) - torch.tensor([[0.2], [0.4]])
    losses = []
    for step in range(60):
        optimizer.zero_grad()
        parts = loss.parts(decoder(points, codes), target, codes, None, None, step / 60)
        sum(parts.values()).backward()
        optimizer.step()
        schedule.step()
        losses.append(parts["sdf"].item())
    assert losses[-1] < losses[0] / 4
