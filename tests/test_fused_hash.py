"""The hash encoding by tiny-cuda-nn against the plain one, the library played by its description."""

import sys
from functools import partial
from types import ModuleType

import pytest
import torch

from sdfhub.errors import SdfhubError
from sdfhub.model import fused_hash
from sdfhub.model.activations import Siren
from sdfhub.model.computing import Computing
from sdfhub.model.decoder import Decoder
from sdfhub.model.encodings import Fourier, Hash
from sdfhub.model.fused_hash import FusedHash, fused
from sdfhub.tasks.run import build_autodecoder
from tests import twin_tinycudann
from tests.test_config import composed

GPU = torch.device("cuda")
GRIDS = {
    "indexed": dict(levels=2, width=2, log2_table=12, coarsest=3, finest=9),
    "hashed": dict(levels=2, width=1, log2_table=2, coarsest=4, finest=40),
    "both": dict(levels=5, width=4, log2_table=9, coarsest=2, finest=64),
    "without points": dict(levels=3, width=2, log2_table=8, coarsest=2, finest=30, include_points=False),
    "one level": dict(levels=1, width=8, log2_table=15, coarsest=16, finest=16),
}


@pytest.fixture
def installed(monkeypatch):
    """tiny-cuda-nn can be imported."""
    module = ModuleType("tinycudann")
    module.Encoding = twin_tinycudann.Encoding
    monkeypatch.setitem(sys.modules, "tinycudann", module)
    monkeypatch.setattr(fused_hash, "find_spec", lambda name: object())
    return module


def filled(**settings) -> Hash:
    encoding = Hash(**settings)
    torch.nn.init.normal_(encoding.table)
    return encoding


@pytest.mark.parametrize("grid", GRIDS)
def test_features_slopes_and_the_tables_gradient_are_those_of_the_plain_encoding(grid, installed):
    plain = filled(**GRIDS[grid])
    twin = FusedHash(plain)
    points = torch.rand(2, 500, 3) * 2.3 - 1.15  # jitter may leave the cube
    torch.testing.assert_close(twin(points), plain(points), rtol=0, atol=2e-4)
    assert fused_hash.disagreement(twin, plain) < 2e-5


def test_a_loss_of_the_fields_gradient_is_differentiated_alike(installed):
    encoding = filled(levels=3, width=2, log2_table=8, coarsest=2, finest=12)
    decoder = Decoder(encoding, partial(Siren, omega_0=3.0, omega_hidden=3.0), 4, 2, 16, weight_norm=False)
    points, codes = torch.rand(2, 9, 3) - 0.5, torch.randn(2, 4)
    found = []
    for decoder.encoding in (FusedHash(encoding), encoding):
        sdf, gradient = decoder.value_and_gradient(points, codes)
        loss = sdf.sum() + gradient.square().sum()
        found.append([sdf, gradient, *torch.autograd.grad(loss, list(decoder.parameters()))])
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-4)


def test_a_decoder_compiles_around_it(installed):
    encoding = filled(levels=3, width=2, log2_table=8, coarsest=2, finest=12)
    decoder = Decoder(encoding, partial(Siren, omega_0=3.0, omega_hidden=3.0), 4, 2, 16, weight_norm=False)
    decoder.encoding = FusedHash(encoding)
    points, codes = torch.rand(2, 9, 3) - 0.5, torch.randn(2, 4)
    found = []
    plain = decoder.value_and_gradient
    for function in (torch.compile(plain, backend="aot_eager"), plain):
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=False):
            sdf, gradient = function(points, codes)
        loss = sdf.sum() + gradient.square().sum()
        found.append([sdf, gradient, *torch.autograd.grad(loss, list(decoder.parameters()))])
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-4)


def test_training_takes_it_and_leaves_nothing_of_it(installed):
    model = build_autodecoder(composed("experiment=hash_siren"), rows=2, steps=10)
    plain, names = model.decoder.encoding, list(model.state_dict())
    weights = {id(weight) for weight in model.parameters()}
    model.decoder.encoding = model.computing.quickest(plain, GPU)
    assert isinstance(model.decoder.encoding, FusedHash)
    assert list(model.state_dict()) == names and {id(weight) for weight in model.parameters()} == weights
    model.on_fit_end()
    assert model.decoder.encoding is plain


def test_it_is_taken_only_where_it_is_there_and_agrees(installed, monkeypatch):
    plain = filled(levels=2, width=2, log2_table=8, coarsest=2, finest=12)
    assert isinstance(fused(plain, GPU), FusedHash)
    assert fused(plain, torch.device("cpu")) is plain
    assert fused(Fourier(2), GPU).plain().features == 12
    odd = filled(levels=2, width=3, log2_table=8, coarsest=2, finest=12)
    assert fused(odd, GPU) is odd
    assert Computing(tinycudann=False).quickest(plain, GPU) is plain
    with pytest.raises(SdfhubError, match="computing.tinycudann=true: needs encoding=hash"):
        Computing(tinycudann=True).quickest(odd, GPU)

    class Shifted(twin_tinycudann.Encoding):
        def forward(self, x):
            return super().forward(x + 0.01)

    installed.Encoding = Shifted
    with pytest.warns(UserWarning, match="tinycudann: goes on without, its grid differs by"):
        assert fused(plain, GPU) is plain
    del installed.Encoding
    with pytest.warns(UserWarning, match="tinycudann: goes on without, AttributeError"):
        assert fused(plain, GPU) is plain
    monkeypatch.setattr(fused_hash, "find_spec", lambda name: None)
    assert fused(plain, GPU) is plain


def test_a_grid_that_learns_otherwise_is_not_taken(installed):
    class Stochastic(twin_tinycudann.Encoding):
        """Right features and slopes, and half the gradient of its table."""

        def forward(self, x):
            return super().forward(x) / 2 + super().forward(x).detach() / 2

    installed.Encoding = Stochastic
    plain = filled(levels=2, width=2, log2_table=8, coarsest=2, finest=12)
    with pytest.warns(UserWarning, match="its grid differs by"):
        assert fused(plain, GPU) is plain
