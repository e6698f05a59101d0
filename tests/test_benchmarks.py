"""The plain training that accuracy.py compares with is the same objective."""

import plain_training
import pytest
import torch

from sdfhub.errors import SdfhubError
from tests.test_training import batches
from tests.tiny import build_autodecoder, composed


@pytest.mark.parametrize(
    "experiment", ["deepsdf", "fft_hosc", "fft_siren_no_normals", "hash_siren", "fft_wire"]
)
def test_a_step_is_that_of_the_plain_training(experiment, several):
    """What accuracy.py compares is the same objective: only how it is computed differs."""
    config = composed(f"experiment={experiment}", "decoder.dropout=0", "computing.points_at_once=70")
    torch.manual_seed(0)
    model, batch = build_autodecoder(config, rows=5), batches(per_step=5)[0]
    have, want = (
        (loss, *parts.values(), *torch.autograd.grad(loss, list(model.parameters())))
        for loss, parts in (
            model.objective(batch, progress=0.5),
            plain_training.objective(model, batch, progress=0.5),
        )
    )
    for one, other in zip(have, want, strict=True):
        assert (one - other).norm() <= 1e-4 * other.norm() + 1e-9  # of DeepSDF's, one is a rounding error


def test_a_plain_training_says_what_it_is_not_written_for():
    model = build_autodecoder(composed("conditioning=film"), rows=5)
    with pytest.raises(SdfhubError, match="conditioning=concat"):
        plain_training.objective(model, batches(per_step=5)[0], progress=0.5)
