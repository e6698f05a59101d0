"""A search is a multirun that chooses its cells as it goes, within a budget that a restart does not renew."""

import pytest
import yaml
from omegaconf import OmegaConf

from sdfhub.errors import SdfhubError
from sdfhub.multirun.search import objective
from sdfhub.report.results import ROLES, read_sweep
from tests.stand_in_training import CONF, of_multirun, stand_in
from tests.sweep_folders import score

pytest.importorskip("hydra_plugins.hydra_optuna_sweeper", reason="hydra-optuna-sweeper is not installed")

SEARCHES = sorted(path.stem for path in (CONF / "hparams_search").glob("*.yaml"))


@pytest.mark.parametrize("search", SEARCHES)
def test_a_search_has_the_budget_of_all_and_settings_of_its_row(search):
    config = of_multirun(lambda config: config, f"hparams_search={search}")
    assert config.hparams_search.trials == 16 and config.hydra.sweeper.n_jobs == 1
    params = dict(config.hydra.sweeper.params)
    assert params.pop("experiment") == search
    row = of_multirun(lambda config: config, f"experiment={search}")
    assert {"optim.lr_decoder", "optim.lr_codes"} <= set(params)
    assert all(isinstance(OmegaConf.select(row, key), float | int) for key in params)


@pytest.fixture
def search(monkeypatch, tmp_path):
    """`python train.py -m hparams_search=fft_hosc scale=tiny ...` without training."""
    training = stand_in(monkeypatch, tmp_path)
    plain_start = training.start
    training.start = lambda *words: plain_start("-m", "hparams_search=fft_hosc", "scale=tiny", *words)
    training.folders = lambda: sorted((tmp_path / "outputs" / "sweeps").iterdir())
    return training


def rates(search) -> list[float]:
    return [config["optim"]["lr_decoder"] for config in search.configs]


def best(drawn: list[float]) -> list[float]:
    return sorted(drawn, key=lambda rate: abs(rate - 1e-3))


def test_an_interrupted_search_goes_on_to_its_budget_and_not_beyond(search):
    search.stop = lambda config, n: n == 2
    assert search.start("hparams_search.trials=2") == 130
    search.stop = lambda config, n: False
    assert search.start("hparams_search.trials=2") == 0
    assert len(search.configs) == 3, "one more trial: the interrupted one has no value"
    assert search.start("hparams_search.trials=2") == 0
    assert len(search.configs) == 3, "the budget is spent"
    (folder,) = search.folders()
    found = yaml.safe_load((folder / "optimization_results.yaml").read_text())
    drawn = rates(search)
    assert found["best_params"]["optim.lr_decoder"] == best(drawn[:1] + drawn[2:])[0]
    states = [cell.state for cell in read_sweep(folder)]
    assert states.count("done") == 2 and (folder / "report" / "report.html").is_file()
    assert search.start("hparams_search.trials=3") == 0
    assert len(set(rates(search))) == 4, "more trials draw other settings"


def test_a_training_that_fails_is_an_answer_and_a_search_of_failures_says_so(search, capsys):
    search.fail = lambda config, n: n > 1
    assert search.start("hparams_search.trials=2") == 1, "as any multirun with a failed cell"
    assert [cell.state for cell in read_sweep(search.folders()[0])] == ["done", "failed"]
    assert search.start("hparams_search.trials=2", "category=lamps") == 1
    printed = "".join(capsys.readouterr())
    assert "2 of 2 cells failed" in printed and "Traceback" not in printed


def test_searches_under_other_settings_are_other_searches(search):
    for words in ((), ("seed=1",), ("data.workers=1",)):
        assert search.start("hparams_search.trials=1", *words) == 0
    assert [config["seed"] for config in search.configs] == [0, 1], "each has its own budget"
    assert all(path.name.startswith("search_fft_hosc_procedural_chairs_tiny_") for path in search.folders())


def test_the_objective_weighs_roles_alike_and_counts_shapes_without_a_surface():
    train, held_out = ROLES
    seen = {"shapes": [score("a", 1e-3), score("b", 6e-3), score("c", 2e-3)]}
    unseen = {"shapes": [score("d", None, penalty=0.4)]}
    floor = 0.05e-3
    of_seen = ((2e-3 - floor) * (3e-3 - floor)) ** 0.5
    assert objective({train: seen}) == pytest.approx(of_seen)
    assert objective({train: seen, held_out: unseen}) == pytest.approx((of_seen * (0.4 - floor)) ** 0.5)
    assert objective({}) == objective({train: {"shapes": []}}) == float("inf")
    distances = [{"id": "a", "sdf_error": 0.01}, {"id": "b", "sdf_error": 0.03}]
    assert objective({train: {"shapes": distances}}) == pytest.approx(0.02), "of sources without meshes"


def test_the_best_trials_of_a_search_come_first_in_another(search, tmp_path):
    from benchmarks.searches import csv_text, enqueue, read_csv, read_search

    assert (
        search.start("hparams_search.trials=3", "trainer.precision=bf16-mixed", "+trainer.max_steps=7") == 0
    )
    wanted = [float(f"{rate:.3g}") for rate in best(rates(search))[:2]]
    file = tmp_path / "trials.csv"
    file.write_text(csv_text({"demo": read_search(search.folders()[0])}))
    trials = read_csv(file)["demo"]
    assert "optim.lr_codes" in trials[0].settings
    assert {"trainer.precision", "trainer.max_steps"}.isdisjoint(trials[0].settings), "they were not drawn"
    other = tmp_path / "other"
    assert [settings["optim.lr_decoder"] for settings in enqueue(trials, other, 2)] == wanted
    assert enqueue(trials, other, 2) == [], "they wait already"
    search.configs = []
    assert search.start("scale=cpu", "hparams_search.trials=2", f"hydra.sweep.dir={other}") == 0
    assert rates(search) == wanted


def test_a_table_of_trials_that_is_none_is_refused_by_name(tmp_path):
    from benchmarks.searches import read_csv

    (tmp_path / "t.csv").write_text("a,b\n1,2\n")
    with pytest.raises(SdfhubError, match="t.csv: not a table of trials"):
        read_csv(tmp_path / "t.csv")
