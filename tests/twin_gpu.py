"""What a GPU would compute, on a device that is not there: `python -m tests.twin_gpu`, a process of its own.

Fake tensors have devices, dtypes and shapes, and no numbers. As on a GPU, what is left on another device is
an error. The device is one that PyTorch keeps free for others: without CUDA no `cuda` tensor can be sliced.
"""

import os
import sys
import traceback
from collections.abc import Callable, Iterable
from functools import cache

import numpy as np
import torch
from torch import nn
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils.backend_registration import _DummyBackendModule, _setup_privateuseone_for_python_backend

from sdfhub.data.loading.batches import Augmentation, Loading, ResidentBatches
from sdfhub.geometry.grid import Grid
from sdfhub.latent.gaussian import Gaussian
from sdfhub.latent.problem import Problem, Rows
from sdfhub.latent.similarity import PoseRange
from sdfhub.model.autodecoder import AutoDecoder
from sdfhub.model.losses import clamped_l1
from tests.tiny import build_autodecoder, composed

torch.utils.rename_privateuse1_backend("twin")
GPU = torch.device("twin", 0)
config_of = cache(composed)
EXPERIMENTS = ("deepsdf", "fft_siren", "hash_hosc", "fft_finer", "fft_gauss", "fft_wire")


class Backend(_DummyBackendModule):
    """What `torch.autocast` asks of a device, even to be told that it is off."""

    def get_amp_supported_dtype(self) -> list[torch.dtype]:
        return [torch.bfloat16]


class Stored:
    """64 rows of each array, as a prepared shape has them."""

    def rows(self, name: str) -> int:
        return 64

    def read(self, name: str, start: int = 0, count: int | None = None) -> np.ndarray:
        return np.full((count or 64, 6 if name == "surface" else 4), 0.25, np.float32)


def model_of(experiment: str, *overrides: str) -> AutoDecoder:
    """A model for six shapes whose parameters and buffers are fakes on the device."""
    with torch._subclasses.fake_tensor.unset_fake_temporarily():
        model = build_autodecoder(config_of(f"experiment={experiment}", *overrides), rows=6)
    for module in model.modules():
        for name, parameter in module._parameters.items():
            if parameter is not None:
                there = torch.empty(parameter.shape, device=GPU)
                module._parameters[name] = nn.Parameter(there, parameter.requires_grad)
        for name, buffer in module._buffers.items():
            module._buffers[name] = torch.empty(buffer.shape, dtype=buffer.dtype, device=GPU)
    return model


def check(tensors: Iterable[torch.Tensor]) -> None:
    assert {tensor.device for tensor in tensors} == {GPU}


def batches() -> ResidentBatches:
    """Batches of three shapes, their tables on the device; some shapes are transformed copies."""
    loading = Loading(3, 20, 5, 1, 0, Augmentation(copies=1), seed=0)
    with torch._subclasses.fake_tensor.unset_fake_temporarily():
        made = ResidentBatches([Stored()] * 3, loading, torch.device("cpu"))
    made.device = GPU
    for name, table in made.tables.items():
        made.tables[name] = torch.empty(table.shape, dtype=table.dtype, device=GPU)
    return made


def train(experiment: str) -> None:
    """A step of the paper's training, in pieces, in float32: autocast has no rules for such a device."""
    model, batch = model_of(experiment, "scale=paper", "computing.points_at_once=20"), batches()[3]
    loss, parts = model.objective(batch, 0.5)
    loss.backward()
    assert ("normal" in parts) == (experiment != "deepsdf")
    check([loss, batch.rows, batch.sdf, batch.surface_normals, *parts.values()])
    check(parameter.grad for parameter in model.parameters())


def fit(experiment: str) -> None:
    """A step of DeepSDF's recipe for codes of unseen shapes."""
    decoder = model_of(experiment).decoder.requires_grad_(False).eval()
    fitted = torch.empty(2, decoder.code_size, device=GPU, requires_grad=True)
    loss = clamped_l1(decoder(torch.empty(2, 8, 3, device=GPU), fitted), torch.empty(2, 8, device=GPU), 0.1)
    loss.backward()
    check([fitted.grad])


def reconstruct_scan(experiment: str) -> None:
    """The objective of a scan in a frame of its own."""
    model = model_of(experiment)
    decoder, codes = model.decoder.requires_grad_(False).eval(), model.codes.table.detach()
    problem = Problem(decoder, [(Gaussian.of(codes, 0.1), 1e-4)], 0.1, PoseRange(4, 10.0, 1.2, 0.1))
    low = torch.empty(2, 8, device=GPU)
    turn = torch.zeros(2, dtype=torch.int64, device=GPU)
    rows = Rows(torch.empty(2, 8, 3, device=GPU), low, low, low > 0, low[:, 0], turn)
    check(problem.about(rows, turn, problem.unknowns(codes[:2])))
    check([Gaussian.of(codes, 0.1).sample(3)])


def evaluate(experiment: str) -> None:
    """The fields at nodes of a grid, up to where they leave the device."""
    model = model_of(experiment)
    seen = []
    grid = Grid(
        lambda points, shapes: seen.append(model.decoder(points, model.codes.table[shapes])),
        range(2), 16, 2**20, GPU,
    )  # fmt: skip
    try:
        grid.evaluate(np.arange(16**3, dtype=np.int32))
    except AttributeError:  # our fields return nothing: numbers there are none
        check(seen)


JOBS: dict[str, Callable[[str], None]] = {
    "training": train,
    "fitting": fit,
    "reconstruction": reconstruct_scan,
    "evaluation": evaluate,
}


def main() -> None:
    _setup_privateuseone_for_python_backend("twin", Backend())
    with FakeTensorMode():
        try:
            check([torch.empty(3, device=GPU) + torch.empty(3)])
        except RuntimeError as error:
            print(f"a tensor left behind: {error}")
        for name, job in JOBS.items():
            for experiment in EXPERIMENTS:
                try:
                    job(experiment)
                except Exception:
                    print(f"{name} of {experiment}: {traceback.format_exc(limit=-3)}")
                else:
                    print(f"{name} of {experiment} stays on the device")
    sys.stdout.flush()
    os._exit(0)  # PyTorch's threads for such a device do not end


if __name__ == "__main__":
    main()
