"""Every choice composes and builds; every mistake on the command line is one clear line."""

import sys

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from omegaconf import OmegaConf

from sdfhub.errors import SdfhubError
from sdfhub.tasks import train as train_task
from sdfhub.tasks.app import register_resolvers, run_task
from sdfhub.tasks.build import build, check, plain
from sdfhub.tasks.conf_files import configuration_folder
from sdfhub.tasks.evaluate import build_evaluation
from sdfhub.tasks.run import build_autodecoder

CONF = configuration_folder()
GROUPS = sorted(folder.name for folder in CONF.iterdir() if folder.is_dir())
OTHER_TASKS = ("method", "prior")
"""Groups of `sdfhub reconstruct` alone."""
TUNED = sorted(path.stem for path in (CONF / "tuned").glob("*.yaml"))
ALL_CHOICES = [(group, path.stem) for group in GROUPS for path in sorted((CONF / group).glob("*.yaml"))]
CHOICES = [(group, choice) for group, choice in ALL_CHOICES if group not in (*OTHER_TASKS, "tuned")]


def composed(*overrides: str, config_name: str = "config"):
    register_resolvers()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        where = (
            []
            if any("runtime.output_dir" in word for word in overrides)
            else ["hydra.runtime.output_dir=here"]
        )
        config = compose(config_name, [*overrides, *where], return_hydra_config=True)
    HydraConfig.instance().set_config(config)
    OmegaConf.set_struct(config, False)
    del config["hydra"]
    return plain(config)


def parameters(module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


@pytest.mark.parametrize(("group", "choice"), CHOICES)
def test_every_choice_composes_and_builds(group, choice):
    config = composed(f"{group}={choice}")
    build_autodecoder(config, rows=2)
    build_evaluation(config["evaluate"], config["loss"])
    build(config["data"]["preparation"], "data.preparation")
    build(config["data"]["loader"], "data.loader")
    build(config["trainer"], "trainer", within="lightning.pytorch")
    if choice not in ("pruning", "wandb", "mlflow"):  # tried by test_callbacks, test_loggers
        for node in (*config["callbacks"].values(), *config["logger"].values()):
            instantiate(node)
    try:
        build(config["data"]["source"], "data.source")
    except SdfhubError as error:  # a source whose root is not on this machine says so
        assert config["data"]["source"].get("root", "?") in str(error)


def choices_of(tuned: str) -> list[str]:
    """The choices after which a file of settings is named."""
    words, rest = [], tuned
    for group in ("scale", "decoder", "activation", "encoding"):
        fitting = [
            choice for owner, choice in CHOICES if owner == group and f"{rest}_".startswith(f"{choice}_")
        ]
        words.append(max(fitting, key=len))
        rest = rest[len(words[-1]) + 1 :]
    assert not rest
    return words


@pytest.mark.parametrize("tuned", TUNED)
def test_settings_of_a_search_are_taken_with_the_choices_that_it_was_made_for(tuned):
    scale, decoder, activation, encoding = choices_of(tuned)
    choices = [f"scale={scale}", f"decoder={decoder}", f"activation={activation}", f"encoding={encoding}"]
    found, without = composed(*choices), composed(*choices, "~tuned")
    assert found == composed(*choices, f"tuned={tuned}") != without
    build_autodecoder(found, rows=2)
    mine = composed(*choices, "optim.lr_decoder=7e-5", "normals.tau=0.03", "scale.omega_0=9")
    assert (mine["optim"]["lr_decoder"], mine["loss"]["tau"]) == (7e-5, 0.03)
    assert mine["activation"].get("omega_0", 9) == 9


def test_normals_off_stay_off_under_settings_of_a_search():
    config = composed("scale=demo", "activation=hosc", "encoding=fourier", "normals=off")
    assert config["loss"]["tau"] == 0 and config["activation"]["beta"] == 1.2


@pytest.mark.parametrize(("group", "choice"), [pair for pair in ALL_CHOICES if pair[0] in OTHER_TASKS])
def test_every_choice_of_reconstruct_composes_and_builds(group, choice):
    config = composed("run=-", "target=-", f"{group}={choice}", config_name="reconstruct")
    for name in ("method", "evidence", "poses", "calibration"):
        build(config[name], name)


def test_issue_groups_are_all_there():
    wanted = {
        "activation": {"relu", "siren", "hosc", "finer", "gauss", "wire"},
        "encoding": {"none", "fourier", "gaussian", "hash"},
        "normals": {"on", "off"},
        "category": {"chairs", "lamps", "planes", "sofas", "tables", "all"},
        "data": {"procedural", "open", "shapenet", "folder", "deepsdf"},
        "decoder": {"small", "paper_585k", "deepsdf"},
        "experiment": {"deepsdf", "siren", "fft_siren", "fft_hosc", "hash_siren"},
        "scale": {"demo", "cpu", "paper"},
        "trainer": {"auto", "cpu", "gpu", "ddp"},
    }
    for group, names in wanted.items():
        assert names <= {choice for owner, choice in CHOICES if owner == group}


def test_deepsdf_preset_has_its_published_size_and_recipe():
    config = composed("experiment=deepsdf", "scale=paper")
    assert parameters(build_autodecoder(config, rows=1).decoder) == 1_843_195
    assert (config["optim"]["lr_decoder"], config["optim"]["lr_codes"]) == (5e-4, 1e-3)
    assert config["trainer"]["max_epochs"] == 2000
    assert config["codes"]["max_norm"] == 1.0
    assert config["loss"]["code_norm"] == "l2"
    assert config["loss"]["tau"] == 0
    loader = config["data"]["loader"]
    assert (loader["shapes_per_step"], loader["samples_per_shape"], loader["passes_per_epoch"]) == (
        64,
        16384,
        1,
    )


@pytest.mark.parametrize("experiment", ["fft_siren", "fft_hosc"])
def test_paper_scale_has_a_third_of_deepsdfs_parameters(experiment):
    decoder = build_autodecoder(composed(f"experiment={experiment}", "scale=paper"), rows=1).decoder
    assert abs(parameters(decoder) / 585_073 - 1) < 1e-3


def test_evaluation_recipe_at_the_papers_scale_is_the_papers():
    config = composed("scale=paper")
    evaluation = build_evaluation(config["evaluate"], config["loss"])
    assert evaluation.points == 30_000
    assert (evaluation.fit.steps, evaluation.fit.lr, evaluation.fit.samples) == (800, 5e-3, 8000)


def test_normals_off_asks_for_no_surface_points():
    config = composed("normals=off")
    assert config["data"]["loader"]["surface_per_shape"] == 0
    assert config["loss"]["tau"] == 0


MISTAKES = {
    "activation=hosk": ["hosk", "finer gauss hosc relu siren wire"],
    "activaton=hosc": ["activaton", "did you mean 'activation'"],
    "activation.betta=3": ["betta", "did you mean 'activation.beta'"],
    "activation.sharpness=3": ["sharpness", "activation.omega_0, activation.omega_hidden", "activation.beta"],
    "+foo=3": ["foo"],
    "fit.steps=3": ["no key 'fit.steps'", "evaluate.fit.steps"],
    "scale.omega=3": ["no key 'scale.omega'", "did you mean 'scale.omega_0'"],
    "hydra.launcher.n_jobs=4": ["no key 'hydra.launcher.n_jobs'; add hydra/launcher=joblib, which has it"],
    "hydra.launcher.n_job=4": ["did you mean 'hydra.launcher.n_jobs' of hydra/launcher=joblib?"],
    "hydra.launcher.nodes=4": ["add hydra/launcher=submitit_local or hydra/launcher=submitit_slurm"],
    "hydra.swep.dir=x": ["no key 'hydra.swep.dir'; --cfg hydra shows those that there are"],
    "tuned=null": ["a group takes", "~GROUP"],
    "seed=0,1": ["Ambiguous value", "add -m"],
    "trainer.precision=16-mixed": ["16-mixed", "bf16-mixed"],
    "trainer.precision=bf16-true": ["bf16-true", "bf16-mixed"],
    "activation.beta=abc": ["activation.beta", "abc"],
    "activation.beta=-1": ["beta", "positive"],
    "optim.lr_decoder=fast": ["optim.lr_decoder", "fast"],
    "data.shapes=many": ["data.shapes", "many"],
    "data.shapes=-4": ["data.shapes=-4", "at least 1"],
    "data.shapes=0": ["data.shapes=0", "at least 1"],
    "data.workers=0": ["data.workers=0: should be greater than 0"],
    "data.held_out=-1": ["data.held_out=-1"],
    "data.loader.samples_per_shape=0": ["data.loader: samples_per_shape"],
    "data.preparation.sign=guess": ["data.preparation.sign", "guess"],
    "data.preparation.samples=1.5": ["data.preparation.samples"],
    "trainer.max_epochs=ten": ["trainer.max_epochs", "ten"],
    "trainer.accelerator=quantum": ["quantum", "trainer.accelerator=auto"],
    "trainer.accelerator=tpu": ["trainer: ", "trainer.accelerator=auto"],
    "trainer.gradient_clip_val=-1": ["trainer.gradient_clip_val=-1", "greater than or equal to 0"],
    "trainer.acelerator=cpu": ["trainer.acelerator"],
    "trainer.max_epochs=0": ["trainer.max_epochs=0", "at least 1"],
    "trainer.max_epochs=null": ["trainer.max_epochs", "at least 1"],
    "trainer.max_epochs=-1": ["trainer.max_epochs=-1", "at least 1"],
    "trainer.precision=foo": ["trainer.precision='foo'", "32-true"],
    "+trainer.strategy=fsdp": ["trainer.strategy=fsdp", "auto or ddp"],
    "output_root=/proc/nowhere": ["/proc/nowhere"],
    "codes.size=7": ["codes.size"],
    "seed=x": ["seed"],
    "ckpt_path=nowhere.ckpt": ["nowhere.ckpt"],
    "data=folder": ["data/meshes"],
    "data=shapenet": ["data/shapenet"],
    "data=deepsdf": ["normals=on", "normals=off"],
    "decoder.width=0": ["decoder", "width"],
    "encoding.frequencies=0": ["frequencies"],
    "codes._target_=os.system": ["codes._target_", "os.system"],
    "decoder._target_=subprocess.Popen": ["decoder._target_"],
    "evaluate.resolution=1": ["resolution"],
    "loss.delta=0": ["delta"],
    "callbacks.mesh.shapes=0": ["shapes"],
}


@pytest.mark.parametrize("override", MISTAKES)
def test_a_mistake_is_one_line_that_names_it(override, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["train.py", override])
    with pytest.raises(SystemExit) as stop:
        train_task.main()
    message = capsys.readouterr().err.strip().splitlines()[-1]
    assert stop.value.code == 2
    assert message.startswith("sdfhub: error: ")
    assert "Traceback" not in message
    for word in MISTAKES[override]:
        assert word in message


@pytest.mark.parametrize(
    "key", ["accumulate_grad_batches=2", "limit_train_batches=5", "limit_train_batches=1"]
)
def test_what_would_change_how_steps_are_counted_is_refused(key, tmp_path):
    """Draws and schedules count a step a batch, and all batches of an epoch."""
    name, value = key.split("=")
    with pytest.raises(SdfhubError, match=rf"trainer\.{name}: .*data\.loader\."):
        train_task.build_parts(composed(f"+trainer.{name}={value}"), tmp_path)


@pytest.mark.parametrize("name", ["logger", "callbacks", "default_root_dir", "plugins"])
def test_what_a_run_decides_of_its_trainer_is_no_setting(name, tmp_path):
    with pytest.raises(SdfhubError, match=rf"trainer\.{name}: is no setting"):
        train_task.build_parts(composed(f"+trainer.{name}=null"), tmp_path)


def test_codes_are_fitted_under_the_clamp_of_the_training(tmp_path):
    config = composed("loss.delta=0.05", "fit=deepsdf")
    assert train_task.build_parts(config, tmp_path).evaluation.fit.delta == 0.05


def test_ctrl_c_is_status_130(monkeypatch, tmp_path):
    def interrupted(config):
        raise KeyboardInterrupt

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["train.py"])
    with pytest.raises(SystemExit) as stop:
        run_task(interrupted, "config")
    assert stop.value.code == 130


def test_build_imports_nothing_outside_its_package(tmp_path, monkeypatch):
    (tmp_path / "canary.py").write_text("raise SystemExit('a stranger ran')\nclass Canary: pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(SdfhubError, match="not a class of"):
        build({"_target_": "canary.Canary"}, "decoder", within="sdfhub.model")
    with pytest.raises(SdfhubError, match=r"there is no|not a class of"):
        build({"_target_": "sdfhub.model.decoder.nn.Linear"}, "decoder", within="sdfhub.model")


def test_check_takes_what_means_the_same_and_refuses_the_rest():
    assert check(2, float, "key") == 2.0
    assert check(None, int | None, "key") is None
    for value, hint in (("abc", float), (1.5, int), ("yes please", bool)):
        with pytest.raises(SdfhubError, match="^key="):
            check(value, hint, "key")


def test_no_yaml_is_left_out_of_its_group():
    for path in CONF.rglob("*.yaml"):
        assert OmegaConf.load(path) is not None
        assert path.parent in (CONF, CONF / "hydra" / "launcher", *(CONF / group for group in GROUPS)), path
