"""A search is a sweep that chooses its cells as it goes, within a budget that a restart does not renew."""

import json
import sys
from pathlib import Path

import pytest
import yaml
from omegaconf import OmegaConf

from sdfhub.errors import SdfhubError
from sdfhub.locks import locked
from sdfhub.report.results import read_sweep
from sdfhub.settings import settings_digest
from sdfhub.tasks import train as train_task
from sdfhub.tasks.names import search_digest
from sdfhub.tasks.search import objective
from sdfhub.tasks.wording import one_line, told_by_plugin
from tests.sweep_folders import score
from tests.test_config import CONF, composed

pytest.importorskip("hydra_plugins.hydra_optuna_sweeper", reason="hydra-optuna-sweeper is not installed")
SEARCHES = sorted(path.stem for path in (CONF / "search").glob("*.yaml"))


def space(search: str) -> dict[str, str]:
    node, chain = {}, [search]
    while chain[-1] != "deepsdf":
        chain.append(yaml.safe_load((CONF / "search" / f"{chain[-1]}.yaml").read_text())["defaults"][0])
    for name in reversed(chain):
        node |= yaml.safe_load((CONF / "search" / f"{name}.yaml").read_text())["hydra"]["sweeper"]["params"]
    return node


@pytest.mark.parametrize("search", SEARCHES)
def test_every_setting_that_is_searched_is_one_of_its_row(search):
    params = space(search)
    assert params.pop("experiment") == search and params.pop("search.of") == "${search_digest:}"
    config = composed(f"experiment={search}")
    for key in params:
        node = config
        for part in key.split("."):
            node = node[part]
        assert isinstance(node, float | int), key


def test_every_row_has_the_same_budget():
    assert {composed(f"search={search}")["search"]["trials"] for search in SEARCHES} == {16}
    rates = [
        {key: space(search)[key] for key in ("optim.lr_decoder", "optim.lr_codes")} for search in SEARCHES
    ]
    assert all(rate == rates[0] for rate in rates)


class Trainer:
    """Stands in for training: the excess grows with the distance of the learning rate from 1e-3."""

    def __init__(self):
        self.rates, self.fail_after, self.kill_after = [], 1000, 1000

    def __call__(self, config: dict, run: Path) -> dict:
        self.rates.append(config["optim"]["lr_decoder"])
        if len(self.rates) > self.kill_after:
            raise KeyboardInterrupt
        if len(self.rates) > self.fail_after:
            raise SdfhubError("the loss is not finite at step 7")
        (run / "config.yaml").write_text(yaml.safe_dump(config))
        (run / "split.json").write_text(json.dumps({"train": ["a"], "held_out": []}))
        metrics = {"training": {"seconds": 1.0, "steps": 5, "parameters": 9}}
        metrics["known"] = {"summary": {}, "shapes": [score("a", 1e-3 + abs(self.rates[-1] - 1e-3))]}
        (run / "metrics.json").write_text(json.dumps(metrics))
        return metrics


@pytest.fixture
def search(monkeypatch, tmp_path):
    """`train.py -m search=fft_hosc` in this process, without training."""
    stand_in = Trainer()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(train_task, "train", stand_in)

    def start(*words: str) -> int:
        monkeypatch.setattr(sys, "argv", ["train.py", "-m", "search=fft_hosc", "scale=demo", *words])
        try:
            train_task.main()
        except SystemExit as stop:
            return stop.code
        return 0

    stand_in.start, stand_in.folders = start, lambda: sorted((tmp_path / "outputs/sweeps").iterdir())
    return stand_in


def test_an_interrupted_search_goes_on_to_its_budget_and_not_beyond(search):
    search.kill_after = 2
    assert search.start("search.trials=4") == 130
    assert len(search.rates) == 3
    search.kill_after = 1000
    assert search.start("search.trials=4") == 0
    assert len(search.rates) == 5, "two more trials: the interrupted one has no value"
    assert search.start("search.trials=4") == 0
    assert len(search.rates) == 5, "the budget is spent"
    found = yaml.safe_load((search.folders()[0] / "optimization_results.yaml").read_text())
    finished = [rate for index, rate in enumerate(search.rates) if index != 2]
    assert found["best_params"]["optim.lr_decoder"] == min(finished, key=lambda rate: abs(rate - 1e-3))
    cells = read_sweep(search.folders()[0])
    assert [cell.state for cell in cells].count("done") == 4
    assert {cell.plan.choices["experiment"] for cell in cells} == {"fft_hosc"}
    assert (search.folders()[0] / "report" / "report.html").is_file()


def test_a_training_that_fails_is_an_answer_and_a_search_of_failures_says_so(search, capsys):
    search.fail_after = 1
    assert search.start("search.trials=2") == 1, "as any sweep with a failed cell"
    assert [cell.state for cell in read_sweep(search.folders()[0])] == ["done", "failed"]
    assert (search.folders()[0] / "optimization_results.yaml").is_file()
    search.fail_after, search.rates = 0, []
    assert search.start("search.trials=2", "category=lamps") == 2
    told = capsys.readouterr().err
    assert "not one training came to its end" in told and "Traceback" not in told


def test_searches_under_other_settings_are_other_searches(search):
    assert search.start("search.trials=2") == 0
    assert search.start("search.trials=2", "seed=1") == 0
    assert len(search.rates) == 4, "each has its own budget"
    both = search.folders()
    assert len(both) == 2
    assert all(folder.name.startswith("search_fft_hosc_procedural_chairs_demo_of-") for folder in both)
    assert [{cell.plan.seed for cell in read_sweep(folder)} for folder in both] in ([{0}, {1}], [{1}, {0}])


def test_a_search_with_more_trials_than_before_draws_other_ones(search):
    assert search.start("search.trials=2") == 0
    assert search.start("search.trials=4") == 0
    assert len(set(search.rates)) == 4


def test_a_search_is_not_lost_when_what_a_row_decides_changes():
    def digest(words=(), tau=0.1, seed=0):
        hydra = {"overrides": {"task": list(words)}}
        parts = {"scale": {"tau": tau}, "normals": {"tau": "${scale.tau}"}, "seed": seed}
        return search_digest(_root_=OmegaConf.create({"hydra": hydra, "search": {"of": None}} | parts))

    assert digest() == digest(tau=0.2) == digest(["evaluate.workers=1"])
    assert len({digest(), digest(seed=1), digest(["normals.tau=0.2"], tau=0.2)}) == 3


def test_a_search_that_runs_already_is_refused(search, capsys, tmp_path):
    folder = tmp_path / "s"
    folder.mkdir()
    with locked(folder / ".search.lock", patience=0):
        assert search.start("search.trials=2", f"hydra.sweep.dir={folder}") == 2
    assert "another process runs this search" in capsys.readouterr().err and search.rates == []


def test_the_objective_of_shapes_without_meshes_is_the_error_of_distances():
    shapes = [{"id": "a", "sdf_error": 0.01, "sign_accuracy": 1.0}, {"id": "b", "sdf_error": 0.03}]
    assert objective({"known": {"shapes": shapes}}) == pytest.approx(0.02)


def test_the_objective_weighs_roles_alike_and_counts_shapes_without_a_surface():
    known = {"shapes": [score("a", 1e-3), score("b", 6e-3), score("c", 2e-3)]}
    held_out = {"shapes": [score("d", None, penalty=0.4)]}
    floor = 0.05e-3
    of_known = ((2e-3 - floor) * (3e-3 - floor)) ** 0.5
    assert objective({"known": known}) == pytest.approx(of_known)
    both = (of_known * (0.4 - floor)) ** 0.5
    assert objective({"known": known, "held_out": held_out}) == pytest.approx(both)
    assert objective({}) is None and objective({"known": {"shapes": []}}) is None


def test_the_budget_is_no_setting_of_a_training():
    one, other = (composed("search=siren", f"search.trials={trials}") for trials in (4, 5))
    assert settings_digest(one) == settings_digest(other)


@pytest.mark.parametrize(
    ("word", "told"),
    [
        ("sweeps=smoke", "search= and sweeps=: a search is no table; leave one of them out"),
        ("search=fft_hosc,siren", "search=fft_hosc,siren: takes one name"),
        ("seed=abc", "seed='abc': should be a valid integer"),
        ("+foo=3", "there is no group or key 'foo'"),
    ],
)
def test_a_search_that_cannot_be_is_refused_once_before_a_folder(word, told, search, capsys, tmp_path):
    assert search.start(word) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith(f"sdfhub: error: {told}") and search.rates == [] and not list(tmp_path.iterdir())


@pytest.mark.parametrize("trials", ["abc", "0", "-1", "1.5", "null"])
def test_a_budget_that_is_none_is_refused_by_name_before_a_folder(trials, search, capsys, tmp_path):
    assert search.start(f"search.trials={trials}") == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("sdfhub: error: search.trials=") and line.endswith(
        ": must be a whole number, at least 1"
    )
    assert not list(tmp_path.iterdir())


def test_a_budget_with_a_point_is_the_same_number(search):
    assert search.start("search.trials=2.0") == 0
    assert len(search.rates) == 2


def test_a_search_without_optuna_or_multirun_says_what_is_missing(monkeypatch, capsys, tmp_path):
    missing = ValueError("In 'search/siren': Could not find 'hydra/sweeper/optuna'\nAvailable options")
    assert "pip install 'sdfhub[optuna]'" in one_line(missing)
    assert told_by_plugin(ValueError("another")) is None
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["train.py", "search=siren"])
    with pytest.raises(SystemExit):
        train_task.main()
    assert "search=siren: is a table of runs; add -m" in capsys.readouterr().err


def test_the_best_trials_of_one_search_come_first_in_another(search, tmp_path):
    from benchmarks.searches import csv_text, enqueue, read_csv, read_search

    assert search.start("search.trials=4") == 0
    other, sweep = tmp_path / "other", f"hydra.sweep.dir={tmp_path / 'other'}"
    best = sorted(search.rates, key=lambda rate: abs(rate - 1e-3))[:2]
    best = [float(f"{rate:.3g}") for rate in best]
    file = tmp_path / "trials.csv"
    file.write_text(csv_text({"demo": read_search(search.folders()[0])}))
    trials = read_csv(file)["demo"]
    assert [trial._replace(scores={}) for trial in trials] == [
        trial._replace(scores={}) for trial in read_search(search.folders()[0])
    ]
    assert [settings["optim.lr_decoder"] for settings in enqueue(trials, other, 2)] == best
    assert enqueue(trials, other, 2) == [], "they wait already"
    search.rates, search.kill_after = [], 1
    assert search.start("scale=cpu", "search.trials=2", sweep) == 130
    assert search.rates == best
    assert [settings["optim.lr_decoder"] for settings in enqueue(trials, other, 2)] == best[1:]
    search.rates, search.kill_after = [], 1000
    assert search.start("scale=cpu", "search.trials=2", sweep) == 0
    assert search.rates == best[1:]


def test_the_settings_of_a_search_of_one_trial_are_those_that_it_drew(search):
    from benchmarks.searches import read_search

    assert search.start("search.trials=1", "trainer.precision=bf16-mixed") == 0, "one trial, nothing differs"
    (trial,) = read_search(search.folders()[0])
    assert set(trial.settings) > {"optim.lr_codes", "optim.lr_decoder"}
    assert "trainer.precision" not in trial.settings


def test_what_a_search_was_told_with_a_plus_or_a_tilde_was_not_drawn(search):
    from benchmarks.searches import KEYS, read_search

    assert search.start("search.trials=1", "~tuned", "+trainer.max_steps=7") == 0
    (trial,) = read_search(search.folders()[0])
    assert {"tuned", "trainer.max_steps"}.isdisjoint(trial.settings) and "optim.lr_codes" in trial.settings
    assert KEYS.findall("python a=1 '~b' '+c.d=[x, y' 'e=cut") == ["python", "a", "b", "c.d", "y", "e"]


def test_a_table_of_trials_that_is_none_is_refused_by_name(tmp_path):
    from benchmarks.searches import read_csv

    (tmp_path / "t.csv").write_text("a,b\n1,2\n")
    with pytest.raises(SdfhubError, match="t.csv: not a table of trials"):
        read_csv(tmp_path / "t.csv")
