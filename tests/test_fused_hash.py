"""The hash encoding by tiny-cuda-nn against the plain one, the library played by its description."""

import sys
from functools import partial
from types import ModuleType

import lightning as L
import pytest
import torch

from sdfhub.data.loading.batches import Loading, StepBatches
from sdfhub.errors import SdfhubError
from sdfhub.model.activations import Siren
from sdfhub.model.decoder import Decoder
from sdfhub.model.encodings import Encoding, Fourier, Hash
from sdfhub.model.fast import fused_hash
from sdfhub.model.fast.computing import Computing
from sdfhub.model.fast.fused_hash import FusedHash, fused
from tests import twin_tinycudann
from tests.test_training import FakeShape
from tests.tiny import build_autodecoder, composed

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


@pytest.mark.parametrize("bf16", [False, True])
def test_a_decoder_compiles_around_it(bf16, installed):
    encoding = filled(levels=3, width=2, log2_table=8, coarsest=2, finest=12)
    decoder = Decoder(encoding, partial(Siren, omega_0=3.0, omega_hidden=3.0), 4, 2, 16, weight_norm=False)
    decoder.encoding = FusedHash(encoding)
    points, codes = torch.rand(2, 9, 3) - 0.5, torch.randn(2, 4)
    found = []
    plain = decoder.value_and_gradient
    for function in (torch.compile(plain, backend="aot_eager"), plain):
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=bf16):
            sdf, gradient = function(points, codes)
        loss = sdf.sum() + gradient.square().sum()
        found.append([sdf, gradient, *torch.autograd.grad(loss, list(decoder.parameters()))])
    for one, other in zip(*found, strict=True):
        assert (one - other).norm() <= (3e-2 if bf16 else 1e-4) * other.norm()


def test_training_takes_it_and_leaves_nothing_of_it(installed, monkeypatch):
    def trained(device: torch.device) -> tuple[list, dict, Encoding]:
        monkeypatch.setattr(Computing, "quickest", lambda self, plain, _: quickest(self, plain, device))
        config = composed("experiment=hash_siren", "computing.compile=false")
        torch.manual_seed(0)
        model = build_autodecoder(config, rows=2)
        shapes = [FakeShape(0.4), FakeShape(0.6)]
        batches = StepBatches(shapes, Loading(2, 64, 16, passes_per_epoch=6))
        data = torch.utils.data.DataLoader(batches, batch_size=None)
        watching = Watching()
        trainer = L.Trainer(
            accelerator="cpu", max_epochs=1, logger=False, callbacks=[watching], enable_progress_bar=False,
            enable_checkpointing=False, enable_model_summary=False, use_distributed_sampler=False,
        )  # fmt: skip
        trainer.fit(model, data)
        return watching.seen, model.state_dict(), model.decoder.encoding

    quickest = Computing.quickest
    plainly, fused_ = trained(torch.device("cpu")), trained(GPU)
    assert plainly[0] == [Hash] * 6 and fused_[0] == [FusedHash] * 6
    assert type(fused_[2]) is Hash and {table.device.type for table in fused_[2].buffers()} == {"cpu"}
    assert fused_[1].keys() == plainly[1].keys()
    for name, weight in fused_[1].items():
        assert (weight - plainly[1][name]).norm() <= 1e-3 * plainly[1][name].norm(), name


class Watching(L.Callback):
    """Which encoding a step used, and that a field is there to be meshed."""

    def __init__(self):
        self.seen: list[type] = []

    def on_train_batch_end(self, trainer, module, *_):
        self.seen.append(type(module.decoder.encoding))
        with torch.inference_mode():
            assert torch.isfinite(module.decoder(torch.rand(1, 5, 3), module.codes.table[:1])).all()


def test_it_is_taken_only_where_it_is_there_and_agrees(installed, monkeypatch):
    plain = filled(levels=2, width=2, log2_table=8, coarsest=2, finest=12)
    odd = filled(levels=2, width=3, log2_table=8, coarsest=2, finest=12)
    taken = Computing().quickest
    assert isinstance(taken(plain, GPU), FusedHash)
    assert taken(plain, torch.device("cpu")) is plain
    assert taken(odd, GPU) is odd and isinstance(taken(Fourier(2), GPU), Fourier)
    assert Computing(tinycudann=False).quickest(plain, GPU) is plain
    for encoding, device in ((odd, GPU), (plain, torch.device("cpu"))):
        with pytest.raises(SdfhubError, match="computing.tinycudann=true: needs encoding=hash"):
            Computing(tinycudann=True).quickest(encoding, device)
    monkeypatch.setattr(torch, "are_deterministic_algorithms_enabled", lambda: True)
    assert taken(plain, GPU) is plain
    assert isinstance(Computing(tinycudann=True).quickest(plain, GPU), FusedHash)
    monkeypatch.undo()
    assert taken(plain, GPU) is plain, "it is not installed"


def test_a_library_that_fails_or_computes_something_else_is_not_taken(installed):
    plain = filled(levels=2, width=2, log2_table=8, coarsest=2, finest=12)

    class Shifted(twin_tinycudann.Encoding):
        def forward(self, x):
            return super().forward(x + 0.01)

    class Half(twin_tinycudann.Encoding):
        """Right features and slopes, and half the gradient of its table."""

        def forward(self, x):
            return super().forward(x) / 2 + super().forward(x).detach() / 2

    for wrong in (Shifted, Half):
        installed.Encoding = wrong
        with pytest.warns(UserWarning, match="tinycudann: goes on without, its grid differs by"):
            assert fused(plain) is plain
        with pytest.warns(UserWarning), pytest.raises(SdfhubError, match="computing.tinycudann=true"):
            Computing(tinycudann=True).quickest(plain, GPU)
    del installed.Encoding
    with pytest.warns(UserWarning, match="tinycudann: goes on without, AttributeError"):
        assert fused(plain) is plain
