"""Objects become plain data and the same objects again; nothing of a stranger's package is built."""

from functools import partial

import pytest
import torch

from sdfhub.described import built, check_arguments, describe
from sdfhub.errors import SdfhubError
from sdfhub.model.activations import Hosc
from sdfhub.model.decoder import Decoder
from sdfhub.model.encodings import Fourier, Identity
from sdfhub.model.losses import SdfLoss


def decoder() -> Decoder:
    return Decoder(Fourier(2), partial(Hosc, omega_0=3, omega_hidden=2, beta=1.5), 4, depth=2, width=8)


def test_a_model_comes_back_from_its_description():
    torch.manual_seed(0)
    first = decoder()
    description = describe(first)
    assert description["activation"] == {
        "_target_": "sdfhub.model.activations.Hosc",
        "_partial_": True,
        "omega_0": 3,
        "omega_hidden": 2,
        "beta": 1.5,
    }
    torch.manual_seed(0)
    second = built(description, "decoder", within="sdfhub.model")
    assert all(
        torch.equal(a, b)
        for a, b in zip(first.state_dict().values(), second.state_dict().values(), strict=True)
    )
    assert describe(second) == description
    assert describe(Identity()) == {"_target_": "sdfhub.model.encodings.Identity"}
    loss = SdfLoss(delta=0.1, lambda_code=1e-4, code_norm="l2", warmup=0.1, tau=0.0)
    assert built(describe(loss), "loss") == loss


@pytest.mark.parametrize(
    "target",
    [
        "os.system",
        "subprocess.Popen",
        "sdfhub.model.decoder.nn.Linear",
        "sdfhub.whole_file.write_whole",
        "canary.Canary",
        3,
    ],
)
def test_a_file_builds_no_other_class(target, tmp_path, monkeypatch):
    (tmp_path / "canary.py").write_text("raise SystemExit('a stranger ran')\nclass Canary: pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(SdfhubError, match="decoder: "):
        built({"_target_": target}, "decoder", within="sdfhub.model")


def test_what_cannot_say_how_it_was_made_is_refused():
    with pytest.raises(SdfhubError, match="encoding: .*make it a dataclass"):
        describe(torch.nn.Linear(2, 2), "encoding")


def test_arguments_are_checked_by_name_and_type():
    check_arguments(Fourier, {"frequencies": 3}, "encoding")
    with pytest.raises(
        SdfhubError, match=r"encoding\.frequncies: no such setting; Fourier takes frequencies"
    ):
        check_arguments(Fourier, {"frequncies": 3}, "encoding")
    with pytest.raises(SdfhubError, match=r"encoding\.frequencies='many'"):
        check_arguments(Fourier, {"frequencies": "many"}, "encoding")
