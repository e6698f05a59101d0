"""Muon and SOAP step hidden matrices as their plain twins, everything else as Adam."""

import copy
from functools import partial

import pytest
import torch
from torch import nn

from sdfhub.model.activations import Siren
from sdfhub.model.conditioning import Film
from sdfhub.model.encodings import Identity
from sdfhub.model.matrix_optimisers import Muon, Soap, orthogonalized
from sdfhub.model.optimisers import Cosine, Optimisation
from tests.test_model import small_decoder

OPTIMISATION = Optimisation(1e-3, 1e-2, Cosine(), optimizer=partial(Muon, lr=4e-3))


def gradients(decoder: nn.Module, codes: nn.Parameter) -> None:
    points = torch.rand(2, 50, 3) - 0.5
    (decoder(points, codes) - points.norm(dim=-1) + 0.3).abs().mean().backward()


@pytest.mark.parametrize("settings", [{}, {"weight_norm": True}, {"conditioning": Film}])
def test_hidden_matrices_are_what_lies_between_first_layer_and_head(settings):
    decoder = small_decoder(Siren(15.0, 3.0), Identity(), **settings)
    shapes = [tuple(matrix.shape) for matrix in decoder.hidden_matrices()]
    assert shapes == [tuple(layer.linear.weight.shape) for layer in decoder.layers[1:-1]] and shapes


@pytest.mark.parametrize("shape", [(30, 50), (50, 30), (20, 20), (1, 9)])
def test_singular_values_come_near_one_and_vectors_stay(shape):
    matrix = torch.randn(shape, dtype=torch.float64)
    u, values, v = torch.linalg.svd(matrix, full_matrices=False)
    values = values / values.norm()
    for _ in range(5):
        values = 3.4445 * values - 4.775 * values**3 + 2.0315 * values**5
    assert torch.allclose(orthogonalized(matrix), u * values @ v, atol=1e-12)
    assert torch.allclose(orthogonalized(matrix.float()), (u * values @ v).float(), atol=1e-4)
    assert values.min() > 0.3 and values.max() < 1.3
    assert not orthogonalized(torch.zeros(shape)).any()


def test_steps_are_those_of_pytorchs_muon_beside_adam():
    torch.manual_seed(0)
    decoder, codes = small_decoder(Siren(15.0, 3.0), Identity()), nn.Parameter(torch.randn(2, 4))
    twin, twin_codes = copy.deepcopy(decoder), copy.deepcopy(codes)
    matrices = decoder.hidden_matrices()
    optimizer, schedule = OPTIMISATION.configure(decoder.parameters(), [codes], 20, matrices)
    sizes = {group["name"]: len(group["params"]) for group in optimizer.param_groups}
    assert sizes["matrices"] == len(matrices) and sizes["codes"] == 1
    matrices = twin.hidden_matrices()
    rest = [p for p in twin.parameters() if all(p is not matrix for matrix in matrices)]
    muon = torch.optim.Muon(matrices, lr=4e-3, weight_decay=0, adjust_lr_fn="match_rms_adamw")
    adam = torch.optim.Adam([{"params": rest, "lr": 1e-3}, {"params": [twin_codes], "lr": 1e-2}])
    for step in range(5):
        factor = OPTIMISATION.factor(step, 20)
        for group, rate in zip([*muon.param_groups, *adam.param_groups], (4e-3, 1e-3, 1e-2), strict=True):
            group["lr"] = rate * factor
        torch.manual_seed(step)
        for parameters in (decoder, twin):
            parameters.zero_grad()
        codes.grad = twin_codes.grad = None
        gradients(decoder, codes)
        pairs = list(zip([*decoder.parameters(), codes], [*twin.parameters(), twin_codes], strict=True))
        before = [mine.detach().clone() for mine, _ in pairs]
        for mine, theirs in pairs:
            theirs.grad = mine.grad.clone()
            theirs.data.copy_(mine)
        optimizer.step()
        muon.step()
        adam.step()
        for (mine, theirs), old in zip(pairs, before, strict=True):
            moved = (theirs - old).abs().max()  # PyTorch's iterations are in bfloat16
            is_matrix = any(theirs is matrix for matrix in matrices)
            assert (mine - theirs).abs().max() < (0.1 if is_matrix else 1e-4) * moved
        schedule.step()


def soap_of(matrix: nn.Parameter, **settings) -> Soap:
    bias = nn.Parameter(torch.zeros(4))
    return Soap([{"params": [matrix], "matrices": True}, {"params": [bias]}], **settings)


def test_soap_is_adam_in_a_turned_basis():
    """Its twin turns the gradient with double precision and lets PyTorch's Adam step what was turned."""
    torch.manual_seed(0)
    matrix = nn.Parameter(torch.randn(6, 4, dtype=torch.float64))
    soap = soap_of(matrix, lr=1e-2, beta=0.9, every=100)
    first = torch.randn(6, 4, dtype=torch.float64)
    left = torch.linalg.eigh(first @ first.T).eigenvectors
    right = torch.linalg.eigh(first.T @ first).eigenvectors
    turned = nn.Parameter(left.T @ matrix.detach() @ right)
    adam = torch.optim.Adam([turned], lr=1e-2, betas=(0.9, 0.9))
    for step in range(8):
        matrix.grad = first if step == 0 else torch.randn_like(first)
        turned.grad = left.T @ matrix.grad @ right
        soap.step()
        adam.step()
        assert torch.allclose(left.T @ matrix @ right, turned, atol=1e-7)


def test_soaps_basis_follows_the_gradients():
    """The power method ends at the eigenvectors of the mean products, of gradients that stay."""
    torch.manual_seed(0)
    u, v = (torch.linalg.qr(torch.randn(4, 4, dtype=torch.float64)).Q for _ in range(2))
    matrix = nn.Parameter(torch.zeros(4, 4, dtype=torch.float64))
    soap = soap_of(matrix, every=1, beta=0.5)
    matrix.grad = torch.randn(4, 4, dtype=torch.float64)
    soap.step()
    for _ in range(60):
        matrix.grad = u @ torch.diag(torch.tensor([4.0, 3.0, 2.0, 1.0], dtype=torch.float64)) @ v.T
        soap.step()
    for basis, true in zip(soap.state[matrix]["bases"], (u, v), strict=True):
        overlap = (basis.T @ true).abs()
        assert torch.allclose(overlap.max(dim=0).values, torch.ones(4, dtype=torch.float64), atol=1e-6)


@pytest.mark.parametrize("kind", [Muon, Soap])
def test_its_state_goes_through_a_checkpoint(kind):
    optimisation = Optimisation(1e-3, 1e-2, Cosine(), optimizer=kind)
    torch.manual_seed(0)
    decoder, codes = small_decoder(Siren(15.0, 3.0), Identity()), nn.Parameter(torch.randn(2, 4))
    twin, twin_codes = copy.deepcopy(decoder), copy.deepcopy(codes)
    made = optimisation.configure(decoder.parameters(), [codes], 20, decoder.hidden_matrices())[0]
    other = optimisation.configure(twin.parameters(), [twin_codes], 20, twin.hidden_matrices())[0]
    gradients(decoder, codes)
    made.step()
    other.load_state_dict(copy.deepcopy(made.state_dict()))
    with torch.no_grad():
        for mine, theirs in zip(
            [*decoder.parameters(), codes], [*twin.parameters(), twin_codes], strict=True
        ):
            theirs.copy_(mine)
            theirs.grad = mine.grad.clone()
    made.step()
    other.step()
    for mine, theirs in zip([*decoder.parameters(), codes], [*twin.parameters(), twin_codes], strict=True):
        assert torch.equal(mine, theirs)
