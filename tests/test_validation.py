"""The quick judgement during a training: what it scores, with whose codes, and what it leaves as it was."""

import pytest
import torch

from sdfhub.evaluation.validation import Validation
from tests.ball_training import Ball, BallDecoder, Item, RadiusFit

CODES = torch.tensor([[-0.1, 0.0], [0.1, 0.0]])
VALIDATION = Validation(RadiusFit(), resolution=48, points=2000)


def test_training_shapes_are_scored_with_their_own_codes_and_held_out_ones_with_fitted_codes():
    train = VALIDATION(BallDecoder(), Item("train", 0, Ball(0.4)), CODES)
    held_out = VALIDATION(BallDecoder(), Item("held_out", None, Ball(0.5)), CODES)
    wrong = VALIDATION(BallDecoder(), Item("train", 1, Ball(0.4)), CODES)
    assert train["sdf_error"] < 1e-6 and held_out["sdf_error"] < 1e-3
    assert max(train["cd"], held_out["cd"]) < 5 < wrong["cd"], "times 10^3; most of it the noise floor"
    assert wrong["sdf_error"] == pytest.approx(0.2, abs=1e-3)
    assert VALIDATION(BallDecoder(), Item("train", 0, Ball(0.4)), CODES) == train


def test_a_field_without_surface_or_numbers_is_a_large_number():
    for offset in (-2.0, torch.nan):
        decoder = BallDecoder()
        decoder.offset.data.fill_(offset)
        scores = VALIDATION(decoder, Item("train", 0, Ball(0.4)), CODES)
        assert scores["cd"] == pytest.approx(2e3 * 0.4**2, rel=1e-2), "that of one point at the origin"


def test_a_shape_without_mesh_is_scored_by_distances_alone():
    assert set(VALIDATION(BallDecoder(), Item("train", 0, Ball(0.4, has_mesh=False)), CODES)) == {"sdf_error"}


def test_it_works_as_lightning_calls_it_and_changes_neither_weights_nor_randomness():
    decoder = BallDecoder().train()
    state = torch.random.get_rng_state()
    with torch.inference_mode():
        VALIDATION(decoder, Item("held_out", None, Ball(0.5)), CODES)
    assert decoder.training and decoder.offset.requires_grad and decoder.offset == 0
    assert torch.equal(torch.random.get_rng_state(), state)


@pytest.mark.parametrize("settings", [{"resolution": 1}, {"points": 0}, {"delta": 0.0}])
def test_settings_out_of_range_are_refused(settings):
    with pytest.raises(ValueError, match=next(iter(settings))):
        Validation(RadiusFit(), **settings)
