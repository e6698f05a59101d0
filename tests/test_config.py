"""Every choice of conf/ composes and builds; mistakes are refused in one line, before a shape is prepared."""

import copy
import re

import pytest
import torch
from hydra.errors import HydraException
from omegaconf import OmegaConf

from sdfhub.composition import configuration_folder, instantiate, plain
from sdfhub.errors import SdfhubError
from sdfhub.model.autodecoder import AutoDecoder
from sdfhub.opening import with_environment
from sdfhub.settings import flat
from sdfhub.tasks.train import make_parts
from tests.tiny import composed, run_command

CONF = configuration_folder()
NO_CHOICES = [("data", "default"), ("category", "any")]
"""What all sources share; the categories of a source that has none."""
NO_CHOICES += [("callbacks", name) for name in composed()["callbacks"]]
"""Parts, which the default lists."""
ALONE = ["experiment", "scale", "debug"]
"""They set keys of other groups."""
ELSEWHERE = ["sweeps", "hparams_search"]
"""They have tests of their own."""


def compositions() -> list[list[str]]:
    """Every choice of conf/ in at least one of them: the n-th choices of most groups together."""
    groups: dict[str, list[str]] = {}
    for path in sorted(CONF.glob("*/*.yaml")):
        group, choice = path.parent.name, path.stem
        if group not in ELSEWHERE and (group, choice) not in NO_CHOICES:
            groups.setdefault(group, []).append(f"{group}={choice}")
    alone = [[word] for group in ALONE for word in groups.pop(group)]
    most = max(len(words) for words in groups.values())
    return alone + [[words[n % len(words)] for words in groups.values()] for n in range(most)]


def parameters(*words: str) -> int:
    decoder = instantiate(composed(*words).decoder, "decoder")
    return sum(parameter.numel() for parameter in decoder.parameters())


@pytest.mark.parametrize("words", compositions(), ids=" ".join)
def test_every_choice_composes_and_builds(words, tmp_path):
    config = composed(*words)
    if config.trainer.accelerator == "gpu" and not torch.cuda.is_available():
        config.trainer.accelerator = "cpu"
    parts = make_parts(config, tmp_path)
    assert isinstance(parts.model(shapes=2), AutoDecoder)


def test_parameters_are_those_of_the_published_decoder_and_of_the_papers():
    assert parameters("experiment=deepsdf", "scale=paper") == 1_843_195
    assert abs(parameters("experiment=fft_siren", "scale=paper") / 585_073 - 1) < 1e-3
    assert abs(parameters("experiment=fft_hosc", "scale=paper") / 585_073 - 1) < 1e-3


def test_deepsdf_at_the_papers_scale_is_the_published_recipe():
    config = composed("experiment=deepsdf", "scale=paper")
    assert (config.optim.lr_decoder, config.optim.lr_codes) == (5e-4, 1e-3)
    assert (config.codes.max_norm, config.loss.code_norm, config.loss.tau) == (1.0, "l2", 0)
    assert (config.trainer.max_epochs, config.evaluate.points) == (2000, 30_000)
    loader = config.data.loader
    assert (loader.shapes_per_step, loader.samples_per_shape, loader.passes_per_epoch) == (64, 16384, 1)
    assert (config.fit.steps, config.fit.lr) == (800, 5e-3)


def test_normals_off_asks_for_no_surface_points():
    config = composed("normals=off")
    assert (config.data.loader.surface_per_shape, config.loss.tau) == (0, 0)


def test_plain_groups_have_the_same_settings_in_every_row_and_experiments_say_their_own():
    rows = [
        composed(f"activation={a}", f"encoding={e}") for a in ("siren", "relu") for e in ("none", "fourier")
    ]
    shared = [(row.optim, row.scale, row.loss, row.data.loader) for row in rows]
    assert all(settings == shared[0] for settings in shared) and not any(row.searched for row in rows)
    assert composed("experiment=fft_hosc").searched and composed("experiment=fft_hosc").optim != rows[0].optim


MISTAKES = {
    "activation.beta=abc": "activation.beta='abc': should be a valid number",
    "+activation.sharpness=3": "activation.sharpness: no such setting; Hosc takes",
    "activation._target_=mypkg.Nothing": "there is no class mypkg.Nothing",
    "data.preparation.sign=guess": "sign",
    "callbacks.mesh.shapes=0": "shapes",
    "trainer.accelerator=quantum": "quantum",
    "trainer.max_epochs=ten": "trainer",
    "+trainer.acelerator=cpu": "trainer.acelerator: no such setting",
    "trainer.precision=16-mixed": "trainer.precision=16-mixed: needs a loss scale",
    "+trainer.strategy=fsdp": "trainer.strategy=fsdp",
    "seed=x": "seed",
    "ckpt_path=nowhere.ckpt": "nowhere.ckpt",
    "data=folder": "data/meshes",
}


@pytest.mark.parametrize("word", MISTAKES)
def test_a_mistake_is_one_line_that_names_it(word, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert run_command(monkeypatch, word) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert lines[-1].startswith("sdfhub: error: ") and MISTAKES[word] in lines[-1], lines
    assert not list(tmp_path.rglob("*.safetensors")), "nothing was prepared"


OUT_OF_RANGE = {
    "activation.beta": -1,
    "optim.lr_decoder": "fast",
    "data.held_out": -1,
    "data.loader.samples_per_shape": 0,
    "decoder.width": 0,
    "encoding.frequencies": 0,
    "evaluate.resolution": 1,
    "loss.delta": 0,
}


def test_a_setting_out_of_range_is_named_before_shapes_are_prepared(tmp_path):
    config = composed("callbacks=none", "logger=none")
    for key, value in OUT_OF_RANGE.items():
        changed = copy.deepcopy(config)
        OmegaConf.update(changed, key, value)
        with pytest.raises(SdfhubError, match=re.escape(f"{key}={value!r}")):
            make_parts(changed, tmp_path)


@pytest.mark.parametrize("group", ["decoder", "loss", "data", "fit", "evaluate", "validation"])
def test_a_number_that_is_none_and_a_negative_count_are_named(group):
    config = composed()
    written = OmegaConf.to_container(config[group])  # what another group fills in stands there as text
    for key, value in flat(written).items():
        if type(value) in (int, float) and not key.endswith("seed"):
            for wrong in ("abc", float("nan") if isinstance(value, float) else -3):
                changed = copy.deepcopy(config)
                OmegaConf.update(changed, f"{group}.{key}", wrong)
                with pytest.raises(SdfhubError, match=key.rpartition(".")[2]):
                    instantiate(changed[group], group)


@pytest.mark.parametrize("word", ["activation=hosk", "activation.betta=3", "foo=3", "seed=0,1"])
def test_hydra_refuses_a_command_line_in_its_own_words(word, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert run_command(monkeypatch, word) == 1
    assert word.partition("=")[0].rpartition(".")[2] in capsys.readouterr().err


def test_the_environment_is_read_and_written_down_as_it_stands(monkeypatch):
    monkeypatch.setenv("MESHES", "/somewhere")
    config = composed("data=folder", "data.source.root='${oc.env:MESHES}/mine'")
    assert config.data.source.root == "/somewhere/mine"
    written = plain(config)["data"]["source"]
    assert written["root"] == "${oc.env:MESHES}/mine"
    assert with_environment(written)["root"] == "/somewhere/mine"


def test_every_yaml_is_one_and_lies_in_a_group():
    for path in CONF.rglob("*.yaml"):
        assert OmegaConf.load(path) is not None, path


def test_two_seeds_give_two_models_and_one_seed_one():
    first, again, other = (
        instantiate_model(composed("decoder.width=8", f"seed={seed}")) for seed in (0, 0, 1)
    )
    assert all((first[name] == again[name]).all() for name in first)
    assert any((first[name] != other[name]).any() for name in first)


def instantiate_model(config):
    config.logger = config.callbacks = {}
    return make_parts(config, configuration_folder()).model(shapes=2).state_dict()


def test_a_composition_without_a_needed_group_is_refused():
    with pytest.raises((HydraException, SdfhubError, Exception), match="scale"):
        plain(composed("~scale"))
