"""Every fast path equals its plain twin."""

import math
from concurrent.futures import ThreadPoolExecutor
from copy import deepcopy
from functools import partial

import pytest
import torch
import torch.nn.functional as F
from torch._dynamo.backends.common import aot_autograd

from sdfhub.data.loading.batches import Augmentation, Loading, ResidentBatches, StepBatches
from sdfhub.errors import SdfhubError
from sdfhub.model.activations import Hosc, Relu, Siren
from sdfhub.model.decoder import activated
from sdfhub.model.dropout import dropout_factors
from sdfhub.model.encodings import Fourier, Gaussian, Hash, Identity
from sdfhub.model.fast import computing, waves
from sdfhub.model.fast.computing import Computing
from sdfhub.model.fast.pieces import loss_in_pieces, pieces
from sdfhub.shapes import Batch
from tests.test_model import ACTIVATIONS as CHOICES
from tests.test_model import small_decoder
from tests.test_training import FakeShape

WAVES = [Siren(15.0, 3.0), Hosc(15.0, 3.0, 2.0, first=True), Hosc(15.0, 3.0, 4.0, learn_beta=False)]
NAMES = ["siren", "hosc", "hosc fixed"]


def products(shapes=3, points=300, width=20):
    torch.manual_seed(0)
    product = torch.randn(shapes, points, width, requires_grad=True)
    return product, torch.randn(shapes, 1, width, requires_grad=True)


def terms_of_beta(activation: Hosc, x: torch.Tensor, given: list[torch.Tensor]) -> torch.Tensor:
    """[B, N, W] what each number contributes to the gradient by log beta."""
    each = deepcopy(activation)  # with a beta of its own for each number
    each.log_beta = torch.nn.Parameter(activation.log_beta.detach().expand_as(x).clone())
    outputs = each.with_slope(x.detach())[: len(given)]
    return torch.autograd.grad(outputs, each.log_beta, [by.double() for by in given])[0]


@pytest.mark.parametrize("activation", WAVES, ids=NAMES)
@pytest.mark.parametrize("per_shape", [True, False], ids=["shift per shape", "bias"])
@pytest.mark.parametrize("points", [300, 128, 3], ids=["ragged chunks", "one chunk", "few points"])
def test_loops_equal_autograd_through_the_plain_formula(activation, per_shape, points):
    product, shift = products(points=points)
    shift = shift if per_shape else torch.randn(20, requires_grad=True)
    exactly = deepcopy(activation).double()
    inputs = [product, shift, *(p for p in activation.parameters() if p.requires_grad)]
    exact_inputs = [tensor.detach().double().requires_grad_() for tensor in (product, shift)]
    exact_inputs += [p for p in exactly.parameters() if p.requires_grad]
    x, exact_x = product + shift, exact_inputs[0] + exact_inputs[1]
    assert waves.fits(activation, product, shift)
    for fast, plain, exact in (
        ([activated(activation, product, shift)[0]], [activation(x)], [exactly(exact_x)]),
        (
            activated(activation, product, shift, sloped=True),
            activation.with_slope(x),
            exactly.with_slope(exact_x),
        ),
    ):
        given = [torch.randn_like(value) for value in plain]
        results = [
            [*values, *torch.autograd.grad(values, learned, by, retain_graph=True)]
            for values, learned, by in (
                (fast, inputs, given),
                (plain, inputs, given),
                (exact, exact_inputs, [by.double() for by in given]),
            )
        ]
        for have, alternative, want in zip(*results, strict=True):  # no further off than the plain formula
            size, allowed = want.abs().max(), (alternative - want).abs().max()
            if want.ndim == 0:  # beta's: a sum of terms of either sign, whose roundings add up like noise
                size = terms_of_beta(exactly, exact_x, given).norm()
            assert (have - want).abs().max() <= 4 * allowed + 2e-6 * size


def test_a_function_of_ones_own_is_not_taken_for_a_sine():
    class Shifted(Siren):
        def forward(self, x):
            return super().forward(x) + 1

    (product, shift), activation = products(), Shifted(3.0, 3.0)
    torch.testing.assert_close(activated(activation, product, shift)[0], activation(product + shift))


def test_the_polynomials_of_the_loops_are_good_to_a_millionth():
    x = torch.linspace(-30, 30, 100_001)[None, :, None]
    zero = torch.zeros(1)
    sine, cosine = activated(Siren(1.0, 1.0), x, zero, sloped=True)
    assert (sine.double() - x.double().sin()).abs().max() < 1e-6
    assert (cosine.double() - x.double().cos()).abs().max() < 1e-6
    steep = activated(Hosc(1.0, 1.0, 20.0), x, zero)[0]
    assert (steep.double() - (20 * x.double().sin()).tanh()).abs().max() < 1e-5  # 20 times the sine's error


@pytest.mark.parametrize("beta", [8.0, 32.0, 100.0])
def test_where_hosc_is_flat_the_loops_say_so(beta):
    """Nearly every point lies there: an error of one sign would add up in the gradient by beta."""
    activation, x = Hosc(1.0, 1.0, beta), torch.linspace(-30, 30, 100_001)[None, :, None]
    exactly = deepcopy(activation).double()
    value, slope = activated(activation, x, torch.zeros(1), sloped=True)
    assert value.abs().max() <= 1 + 2**-23
    exact_slope = exactly.with_slope(x.double())[1]
    assert ((slope - exact_slope) * exact_slope.sign()).mean().abs() < 1e-6
    by = x.sin().sign()  # all terms have the same sign
    (have,) = torch.autograd.grad(value, activation.log_beta, by)
    terms = terms_of_beta(exactly, x.double(), [by])
    assert (have - terms.sum()).abs() < 3e-5 * terms.abs().sum()


def test_numbers_that_are_not_finite_stay_so():
    product = torch.tensor([[[float("nan"), float("inf"), 1.0]]])
    value = activated(Hosc(5.0, 3.0, 2.0), product, torch.zeros(3))[0]
    assert value[0, 0, :2].isnan().all() and value[0, 0, 2].isfinite()


def test_the_loops_take_callers_from_several_threads(several):
    product, shift = products(points=3000)
    assert product.numel() > waves.ALONE
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: activated(Siren(15.0, 3.0), product, shift)[0], range(16)))
    assert all(torch.equal(value, found[0]) for value in found)
    assert torch.get_num_threads() == several


def test_what_stands_beside_an_activation_has_gradients_of_its_own():
    activation, (product, shift) = Hosc(5.0, 3.0, 2.0), products()
    beside = torch.randn(3, 300, 7, requires_grad=True)
    by_value, by_slope = torch.randn(3, 300, 27), torch.randn(3, 300, 20)

    def gradients(value, slope, again=False):
        inputs = product, shift, activation.log_beta, beside
        found = torch.autograd.grad([value, slope], inputs, [by_value, by_slope], create_graph=again)
        squares = [part.square().sum() for part in found[:1]]
        return torch.autograd.grad(squares, [product, shift]) if again else found

    for again in (False, True):
        value, slope = activation.with_slope(product + shift)
        plain = gradients(torch.cat([value, beside], dim=-1), slope, again)
        fast = gradients(*activated(activation, product, shift, sloped=True, beside=beside), again)
        for have, want in zip(fast, plain, strict=True):
            assert (have - want).abs().max() < 1e-4 * want.abs().max()


def test_the_loops_gradient_can_be_differentiated_again():
    activation = Hosc(5.0, 3.0, 2.0)
    product, shift = products()

    def bent(value):
        (slope,) = torch.autograd.grad(value.sum(), product, create_graph=True)
        return torch.autograd.grad(slope.square().sum(), [product, shift, activation.log_beta])

    fast, plain = bent(activated(activation, product, shift)[0]), bent(activation(product + shift))
    for have, want in zip(fast, plain, strict=True):
        torch.testing.assert_close(have, want, rtol=1e-3, atol=1e-2)


@pytest.mark.parametrize("dropout", [0.2, 0.5])
def test_dropout_keeps_the_right_share_unbiased_and_seeded(dropout):
    torch.manual_seed(3)
    factors = dropout_factors(torch.empty(400, 500), dropout)
    torch.manual_seed(3)
    assert torch.equal(factors, dropout_factors(torch.empty(400, 500), dropout))
    share = (factors == 0).float().mean()
    assert float(share) == pytest.approx(dropout, abs=4e-3)
    assert float(factors.mean()) == pytest.approx(1, abs=1e-2)
    assert float(factors.max()) == pytest.approx(1 / (1 - dropout), rel=1e-4)
    neighbours = (factors[:, 1:] * factors[:, :-1]).mean()
    assert float(neighbours) == pytest.approx(1, abs=1e-2), "neighbours are dropped independently"
    plain = F.dropout(torch.ones(400, 500), dropout)
    assert float(factors.mean(dim=1).std()) == pytest.approx(float(plain.mean(dim=1).std()), rel=0.2)


def random_batch(shapes=5, samples=33, surface=9) -> Batch:
    torch.manual_seed(1)
    normals = F.normalize(torch.randn(shapes, surface, 3), dim=-1)
    points = torch.rand(shapes, samples, 3) - 0.5
    return Batch(
        torch.arange(shapes), points, torch.randn(shapes, samples), torch.rand(shapes, surface, 3), normals
    )


@pytest.mark.parametrize("together", [1, 10, 33, 70, 1000])
def test_a_batch_in_pieces_has_the_loss_and_gradient_of_the_whole(together):
    batch = random_batch()
    decoder, table = small_decoder(), torch.nn.Parameter(torch.randn(5, 4))

    def parts_of(part: Batch):
        codes = table[part.rows]
        _, gradients = decoder.value_and_gradient(part.surface_points, codes)
        normal = (
            (gradients - part.surface_normals).square().sum(-1).mean()
            if gradients.numel()
            else table.sum() * 0
        )
        sdf = (decoder(part.points, codes) - part.sdf).abs().mean()
        return {"sdf": sdf, "code": codes.square().sum(-1).mean(), "normal": normal}

    learned = [table, *decoder.parameters()]
    plain = parts_of(batch)
    want = torch.autograd.grad(sum(plain.values()) * 3, learned)
    loss, parts = loss_in_pieces(parts_of, batch, together, learned)
    have = torch.autograd.grad(loss * 3, learned)
    for name in plain:
        torch.testing.assert_close(parts[name], plain[name])
    for one, other in zip(have, want, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-6)
    if together < batch.sdf.numel():
        sizes = [piece.sdf.numel() for piece, _, _ in pieces(batch, together)]
        assert max(sizes) <= together and sum(sizes) == batch.sdf.numel()


@pytest.mark.parametrize("copies", [0, 3])
def test_resident_samples_give_the_batches_of_the_store(copies):
    shapes = [FakeShape(0.4), FakeShape(0.5), FakeShape(0.6)]
    loading = Loading(
        4, 9001, 70, 1, 0, Augmentation(copies), seed=5
    )  # more samples than there are rows: they wrap
    streamed, resident = StepBatches(shapes, loading), ResidentBatches(shapes, loading, torch.device("cpu"))
    for step in (0, 1, 7):
        one, other = streamed[step], resident[step]
        assert torch.equal(one.rows, other.rows)
        for name in ("points", "sdf", "surface_points", "surface_normals"):
            have, want = getattr(other, name), getattr(one, name)
            if name == "sdf":  # far distances are cut, far outside of what the loss clamps
                have, want = have.clamp(-0.9, 0.9), want.clamp(-0.9, 0.9)
            torch.testing.assert_close(have, want, rtol=0, atol=2.4e-5)


def test_resident_samples_refuse_what_the_store_refuses():
    shape = FakeShape(0.4)
    shape.rows = lambda name: 0 if name == "surface" else 100
    shape.id = "chairs/a"
    with pytest.raises(SdfhubError, match="chairs/a: holds no surface samples"):
        ResidentBatches([shape], Loading(1, 8, 4, 1, 0, Augmentation(), seed=5), torch.device("cpu"))


@pytest.mark.parametrize("choice", ["relu", "hosc"])
def test_value_and_gradient_compile_to_one_graph(choice):
    decoder = small_decoder(CHOICES[choice], Fourier(2))
    points, codes = torch.rand(2, 7, 3) - 0.5, torch.randn(2, 4)
    compiled = torch.compile(decoder.value_and_gradient, backend="aot_eager", fullgraph=True)
    have, want = compiled(points, codes), decoder.value_and_gradient(points, codes)
    for one, other in zip(have, want, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)
    learned = list(decoder.parameters())
    derivatives = [
        torch.autograd.grad(value.sum() + grad.square().sum(), learned) for value, grad in (have, want)
    ]
    for one, other in zip(*derivatives, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-4)


def test_computing_takes_what_suits_the_device():
    function = len
    cpu, gpu = torch.device("cpu"), torch.device("cuda")
    assert Computing().together(cpu, 2**30) < Computing().together(gpu, 2**30)
    assert Computing(points_at_once=5).together(gpu, 100) == 5
    assert Computing().compiled(function, device=cpu) == (function,)
    assert Computing(compile=False).compiled(function, device=gpu) == (function,)
    assert Computing(compile=True).compiled(function, device=cpu) != (function,)
    with pytest.raises(ValueError, match="points_at_once"):
        Computing(points_at_once=0)
    try:
        Computing(matmul="medium").set_up(cpu)
        assert torch.get_float32_matmul_precision() == "medium"
    finally:
        torch.set_float32_matmul_precision("highest")


def test_on_a_gpu_without_compilers_nothing_is_compiled(monkeypatch):
    gpu = torch.device("cuda")
    monkeypatch.setattr(computing.shutil, "which", lambda name: "/usr/bin/cc")
    monkeypatch.setattr(computing, "find_spec", lambda name: None if name == "triton" else object())
    assert Computing().compiled(len, device=gpu) == (len,)
    monkeypatch.setattr(computing, "find_spec", lambda name: object())
    assert Computing().compiled(len, device=gpu) != (len,)
    monkeypatch.setattr(computing.shutil, "which", lambda name: None)
    assert Computing().compiled(len, device=gpu) == (len,)


@pytest.mark.parametrize("part", ["forward", "backward"])
def test_what_does_not_compile_runs_as_it_is_unless_it_was_asked_for(part, monkeypatch):
    def refuse(graph, inputs):
        raise RuntimeError("PTXAS: too much shared memory")

    plain = dict.fromkeys(("fw_compiler", "bw_compiler"), lambda graph, inputs: graph)
    backend = aot_autograd(**plain | {f"{part[0]}w_compiler": refuse})
    monkeypatch.setattr(torch, "compile", partial(torch.compile, backend=backend))
    monkeypatch.setattr(computing, "find_spec", lambda name: object())
    monkeypatch.setattr(computing.shutil, "which", lambda name: "/usr/bin/cc")
    (wave,) = Computing().compiled(lambda x: x * x.sin(), device=torch.device("cuda"))
    x = torch.ones(3, requires_grad=True)
    wave(x).sum().backward()
    torch.testing.assert_close(x.grad, torch.full((3,), math.sin(1) + math.cos(1)))
    (asked,) = Computing(compile=True).compiled(lambda x: x * x.sin(), device=torch.device("cuda"))
    with pytest.raises(Exception, match="PTXAS"):
        asked(x).sum().backward()


def test_pieces_are_differentiated_outside_of_autocast_as_a_whole_batch_is():
    weight = torch.nn.Parameter(torch.randn(4, 3))
    seen = []

    def parts_of(piece):
        product = piece.points @ weight.T
        product.register_hook(lambda _: seen.append(torch.is_autocast_enabled("cpu")))
        return {"sdf": product.float().square().mean()}

    batch = Batch(
        torch.arange(2), torch.rand(2, 8, 3), torch.rand(2, 8), torch.zeros(2, 0, 3), torch.zeros(2, 0, 3)
    )
    with torch.autocast("cpu", dtype=torch.bfloat16):
        loss_in_pieces(parts_of, batch, 4, [weight])
    assert seen == [False] * 4


@pytest.mark.parametrize(
    "encoding",
    [Identity(), Fourier(3), Gaussian(6, 1.0), Hash(2, 2, 8, 4, 8)],
    ids=lambda one: type(one).__name__,
)
def test_under_bfloat16_every_encoding_sees_places_in_float32(encoding):
    decoder = small_decoder(CHOICES["siren"], encoding)
    points, codes = torch.rand(2, 7, 3) - 0.5, torch.randn(2, 4)
    seen = []
    decoder.layers[0].register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        decoder(points, codes)
        sdf, gradient = decoder.value_and_gradient(points, codes)
    for encoded in seen:
        torch.testing.assert_close(encoded, encoding(points), rtol=0, atol=0)
    want = decoder.value_and_gradient(points, codes)
    for one, other in zip((sdf, gradient), want, strict=True):
        assert one.dtype == torch.float32
        assert (one - other).norm() < 0.05 * other.norm()
    (sdf.sum() + gradient.square().sum()).backward()
    assert all(torch.isfinite(p.grad).all() for p in decoder.parameters())


def test_a_shift_of_another_width_is_refused_not_read_beyond_its_end():
    product, shift = products()
    for wrong in (shift[:2], torch.zeros(21)):
        with pytest.raises(RuntimeError, match="must match"):
            activated(WAVES[0], product, wrong)


@pytest.mark.parametrize("activation", [Relu(), *WAVES], ids=["relu", *NAMES])
def test_in_bfloat16_layers_are_worked_out_by_tensor_operations(activation):
    product, shift = products()
    exact = activation.with_slope(product + shift)
    with torch.autocast("cpu", torch.bfloat16):
        have = activated(activation, product.bfloat16(), shift, sloped=True)
    for one, other in zip(have, exact, strict=True):
        assert one.dtype == torch.bfloat16
        assert (one.float() - other).square().mean() < 0.05**2 * other.square().mean()
