"""Losses, schedules and batches: the equations and the order of the draws."""

import dataclasses

import numpy as np
import pytest
import torch

from sdfhub.data.loading.batches import Augmentation, Loading, StepBatches
from sdfhub.data.loading.datamodule import EpochSteps
from sdfhub.data.store.stored_shape import draw_rows
from sdfhub.errors import SdfhubError
from sdfhub.model.losses import SdfLoss, clamped_l1, code_prior, normal_term
from sdfhub.model.optimisers import Cosine, Optimisation, StepDecay
from sdfhub.shapes import Batch

LOSS = SdfLoss(delta=0.1, lambda_code=1e-4, code_norm="squared", warmup=0.2, tau=0.01)


@dataclasses.dataclass
class FakeShape:
    """Arrays in the place of a stored shape: a ball of a given radius."""

    radius: float

    def __post_init__(self):
        rng = np.random.default_rng(int(self.radius * 1000))
        points = rng.uniform(-1, 1, (4000, 3)).astype(np.float32)
        sdf = np.linalg.norm(points, axis=1) - np.float32(self.radius)
        rows = np.column_stack([points, sdf]).astype(np.float32)
        self.outside, self.inside = rows[sdf >= 0], rows[sdf < 0]
        normals = points / np.linalg.norm(points, axis=1, keepdims=True)
        self.surface = np.column_stack([normals * self.radius, normals]).astype(np.float32)

    def rows(self, name: str) -> int:
        return len(getattr(self, name))

    def read(self, name: str, start: int = 0, count: int | None = None) -> np.ndarray:
        count = self.rows(name) if count is None else count
        return np.take(getattr(self, name), np.arange(start, start + count), axis=0, mode="wrap")

    def read_into(self, rows: np.ndarray, name: str, start: int) -> None:
        rows[:] = self.read(name, start, len(rows))


def batches(shapes=5, per_step=2, samples=64, surface=16, augmentation=None, seed=0) -> StepBatches:
    balls = [FakeShape(0.4 + 0.05 * index) for index in range(shapes)]
    return StepBatches(balls, Loading(per_step, samples, surface, 1, 0, augmentation or Augmentation(), seed))


def test_clamped_l1_counts_only_the_band():
    predicted, target = torch.tensor([[0.05, 0.5, -0.5, 0.3]]), torch.tensor([[0.02, 0.2, 0.2, 0.05]])
    assert torch.isclose(clamped_l1(predicted, target, 0.1), torch.tensor((0.03 + 0 + 0.2 + 0.05) / 4))


def test_errors_beyond_the_band_may_count_more():
    predicted, target = torch.tensor([[0.05, 0.0, 0.2, 0.3]]), torch.tensor([[0.02, 0.2, -0.3, 0.3]])
    assert torch.isclose(
        clamped_l1(predicted, target, 0.1, 5.0), torch.tensor((0.03 + 5 * 0.1 + 5 * 0.2) / 4)
    )
    parts = dataclasses.replace(LOSS, far_weight=5.0).parts(
        predicted, target, torch.zeros(1, 2), None, None, 1.0
    )
    assert torch.isclose(parts["sdf"], torch.tensor(1.53 / 4))


def test_code_prior_is_the_papers_square_or_deepsdfs_norm():
    codes = torch.tensor([[3.0, 4.0], [0.0, 0.0]], requires_grad=True)
    assert code_prior(codes, "squared") == 12.5
    assert torch.isclose(code_prior(codes, "l2"), torch.tensor(2.5))
    code_prior(codes, "l2").backward()
    assert torch.isfinite(codes.grad).all()


def test_normal_term_is_the_mean_squared_difference():
    gradients, normals = torch.zeros(1, 2, 3), torch.tensor([[[1.0, 0, 0], [0, 2.0, 0]]])
    assert normal_term(gradients, normals) == 2.5


def test_prior_warms_up_and_parts_add_their_weights():
    args = torch.zeros(1, 4), torch.zeros(1, 4), torch.ones(1, 4)
    half = LOSS.parts(*args, None, None, progress=0.1)
    assert torch.isclose(half["code"], torch.tensor(1e-4 * 0.5 * 4))
    assert torch.isclose(LOSS.parts(*args, None, None, progress=0.9)["code"], torch.tensor(1e-4 * 4))
    with_normals = LOSS.parts(*args, torch.zeros(1, 2, 3), torch.ones(1, 2, 3), progress=0)
    assert torch.isclose(with_normals["normal"], torch.tensor(0.01 * 3))
    assert set(half) == {"sdf", "code"}


def test_normals_may_come_in_later():
    late = dataclasses.replace(LOSS, tau_start=0.4)
    assert not late.wants_gradients(0.39)
    assert late.wants_gradients(0.4)
    assert not dataclasses.replace(LOSS, tau=0.0).wants_gradients(1.0)


def test_step_schedule_halves_every_500_of_2000_epochs():
    schedule = StepDecay(every=0.25, factor=0.5)
    assert [schedule(epoch / 2000) for epoch in (0, 499, 500, 1000, 1999)] == [1, 1, 0.5, 0.25, 0.125]


def test_cosine_schedule_falls_from_one_to_its_end():
    schedule = Cosine(final=0.01)
    assert schedule(0.0) == pytest.approx(1)
    assert schedule(0.5) == pytest.approx((1 + 0.01) / 2)
    assert schedule(1.0) == pytest.approx(0.01)


@pytest.mark.parametrize(("steps", "reached"), [(1000, 100), (60, 30)])
def test_warm_up_is_counted_in_steps_but_takes_no_more_than_half_of_training(steps, reached):
    optim = Optimisation(1e-3, 1e-2, Cosine(final=1.0), warmup_steps=100)
    assert optim.factor(0, steps) == pytest.approx(1 / reached)
    assert optim.factor(reached - 2, steps) < 1
    assert optim.factor(reached - 1, steps) == optim.factor(steps, steps) == 1


def test_each_group_has_its_own_learning_rate():
    decoder, codes = torch.nn.Parameter(torch.ones(2)), torch.nn.Parameter(torch.ones(2))
    optimizer, _ = Optimisation(1e-3, 1e-2, Cosine()).configure([decoder], [codes], steps=10)
    assert {group["name"]: group["lr"] for group in optimizer.param_groups} == {
        "decoder": 1e-3,
        "codes": 1e-2,
    }


def test_drawn_rows_reach_every_row_equally():
    shape, rng = FakeShape(0.5), np.random.default_rng(0)
    shape.inside = np.arange(10)[:, None]
    drawn = np.empty((5000, 4, 1), int)
    for rows in drawn:
        draw_rows(rows, shape, "inside", rng)
    assert np.bincount(drawn.ravel(), minlength=10).std() < 60
    more = np.full((25, 1), -1)
    draw_rows(more, shape, "inside", rng)
    assert np.bincount(more.ravel()).min() >= 2
    draw_rows(more[:0], shape, "inside", rng)


def test_a_batch_is_a_function_of_seed_and_step():
    one, two, other = batches()[7], batches()[7], batches(seed=1)[7]
    assert torch.equal(one.points, two.points) and torch.equal(one.rows, two.rows)
    assert not torch.equal(one.points, other.points)
    assert not torch.equal(one.points, batches()[8].points)


def test_half_of_the_samples_are_inside():
    assert ((batches()[0].sdf < 0).sum(dim=1) == 32).all()


def test_a_pass_visits_no_shape_twice_and_the_next_shuffles_anew():
    stream = batches(shapes=6, per_step=2)
    passes = [torch.cat([stream[p * 3 + i].rows for i in range(3)]).tolist() for p in range(4)]
    assert all(sorted(rows) == list(range(6)) for rows in passes)
    assert len({tuple(rows) for rows in passes}) > 1


def test_processes_share_a_step_without_overlap():
    whole, halves = batches(per_step=4)[3], []
    for rank in range(2):
        stream = batches(per_step=4)
        stream.share(rank, 2)
        halves.append(stream[3])
    assert sorted(torch.cat([half.rows for half in halves]).tolist()) == sorted(whole.rows.tolist())
    merged = {int(r): p for half in halves for r, p in zip(half.rows, half.points, strict=True)}
    assert all(torch.equal(merged[int(r)], p) for r, p in zip(whole.rows, whole.points, strict=True))
    with pytest.raises(SdfhubError, match="multiple of 3"):
        batches(per_step=4).share(0, 3)


def test_an_epoch_goes_on_where_the_last_ended():
    done = 8
    steps = EpochSteps(4, done=lambda: done)
    assert list(steps) == [8, 9, 10, 11]
    done = 10  # stopped in the middle of an epoch: the trainer ends it
    assert list(steps) == [10, 11, 12, 13] and len(steps) == 4


def test_augmented_copies_are_exact_signed_distances_of_similar_shapes():
    stream = batches(shapes=2, per_step=6, augmentation=Augmentation(copies=2, smallest=0.5))
    assert stream.rows == 6
    batch = stream[0]
    radius = (batch.points.norm(dim=-1) - batch.sdf).mean(dim=1)  # a scaled ball is a ball
    assert torch.allclose(batch.points.norm(dim=-1) - radius[:, None], batch.sdf, atol=1e-5)
    assert torch.allclose(batch.surface_normals.norm(dim=-1), torch.ones(6, 16), atol=1e-5)
    outward = (batch.surface_points * batch.surface_normals).sum(-1)
    assert torch.allclose(outward, radius[:, None].expand_as(outward), atol=1e-4)
    assert len({round(float(r), 4) for r in radius}) == 6


def test_a_wrong_batch_is_refused_at_its_seam():
    rows, points = torch.zeros(2, dtype=torch.int64), torch.zeros(2, 4, 3)
    none = torch.zeros(2, 0, 3)
    with pytest.raises(ValueError, match="sdf"):
        Batch(rows, points, torch.zeros(2, 5), none, none)
    with pytest.raises(ValueError, match="rows"):
        Batch(rows.float(), points, torch.zeros(2, 4), none, none)
