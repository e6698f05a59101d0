"""A sweep's report: numbers equal those made by hand, what is not there is said, and nothing is injected."""

import csv
import json
import math
import re
import shutil
import subprocess
import sys

import numpy as np
import pytest
import yaml
from torch.utils.tensorboard import SummaryWriter

from sdfhub.errors import SdfhubError
from sdfhub.locks import locked
from sdfhub.report import curves, pictures
from sdfhub.report.claims import verdicts
from sdfhub.report.drawings import packed
from sdfhub.report.formats import csv_text, latex, markdown, shapes_csv
from sdfhub.report.meshes import Mesh, reconstruction
from sdfhub.report.origin import origin_table
from sdfhub.report.page import page
from sdfhub.report.paper import CLAIMS, COSTS, PRINTED
from sdfhub.report.pictures import Gallery
from sdfhub.report.plan import PLAN, enter_cells, read_plan
from sdfhub.report.results import read_sweep
from sdfhub.report.rows import estimate, group_cells
from sdfhub.report.tables import claims_table, overview, tables
from sdfhub.tasks import report as report_task
from sdfhub.tasks.report import sheet_name, write_report
from tests.sweep_folders import planned, score, write_cell, write_mesh


def only_group(sweep):
    (group,) = group_cells(read_sweep(sweep))
    return group


def page_of(sweep, name="sweep"):
    """The page of a sweep whose true shapes are not on this machine."""
    cells = read_sweep(sweep)
    origin = origin_table(read_plan(sweep).commands, cells)
    return page(name, cells, group_cells(cells), origin, Gallery(lambda cell, id: None), 2)


@pytest.fixture
def small(tmp_path):
    """DeepSDF and FFT/SIREN, two seeds each, three known shapes and a held-out one."""
    sweep = tmp_path / "table_small"
    deepsdf = {"seconds": 300, "parameters": 4000}
    write_cell(sweep, planned("DeepSDF", "off", 0), [0.2e-3, 0.4e-3, 0.6e-3], [0.9e-3], **deepsdf)
    write_cell(sweep, planned("DeepSDF", "off", 1), [0.4e-3, 0.6e-3, 0.8e-3], [1.1e-3], **deepsdf)
    write_cell(sweep, planned("FFT/SIREN", "on", 0), [0.1e-3, 0.1e-3, 0.4e-3], [0.3e-3])
    write_cell(sweep, planned("FFT/SIREN", "on", 1), [0.2e-3, 0.2e-3, 0.2e-3], [0.5e-3])
    return sweep


def test_a_table_equals_what_is_computed_by_hand(small):
    """Means over seeds: DeepSDF (.4 + .6) / 2, FFT/SIREN (.2 + .2) / 2; t(.975, 1) = 12.706."""
    group = only_group(small)
    known, beside, held_out, cost = tables(group)
    half = 12.7062 * math.sqrt(0.02) / math.sqrt(2)
    assert known.rows[0][:8] == [
        "DeepSDF",
        f"0.5000 ± {half:.4f}",
        f"0.5000 ± {half:.4f}",
        "0.0500",
        f"0.4500 ± {half:.4f}",
        f"0.4500 ± {half:.4f}",
        "0.900",
        "0/6",
    ]
    assert known.rows[1][0] == "FFT/SIREN + normals"
    assert known.rows[1][1] == "0.2000", "both seeds have the same mean: no interval to print"
    assert known.rows[1][2] == f"0.1500 ± {half / 2:.4f}"
    assert known.rows[1][9:] == [f"{0.15 / 0.45:.3g}", f"{0.10 / 0.45:.3g}"], "excess over DeepSDF's"
    assert known.best == {(1, 1), (1, 2), (1, 4), (1, 5)}
    assert beside.rows[1][1:5] == ["0.2000", "0.1284", "0.4", f"{0.1284 / 0.2076:.3g}"]
    assert beside.rows[1][7:] == ["0.3", f"{0.0508 / 0.0432:.3g}"]
    assert held_out.rows[1][1].startswith("0.4000 ±")
    samples = 50 * 3 * 256  # three shapes are fewer than the 20 of a step
    assert cost.rows[1][1:8] == ["3", "1,000", "90", "50", f"{samples:,}", "100 s", f"{1 / 3:.3g}"]


def test_the_csv_carries_the_same_numbers(small):
    lines = list(csv.DictReader(csv_text([only_group(small)]).splitlines()))
    row = next(line for line in lines if line["method"] == "FFT/SIREN" and line["role"] == "known")
    assert float(row["cd_median"]) == pytest.approx(0.15e-3)
    assert float(row["cd_median_ci95"]) == pytest.approx(
        12.7062 * math.sqrt(0.005e-6) / math.sqrt(2), rel=1e-4
    )
    assert (row["cd_median_seeds"], row["cells"], row["parameters"]) == ("2", "2", "1000.0")


def test_an_interval_is_students_and_one_seed_has_none():
    three = estimate([1.0, 2.0, 3.0])
    assert (three.mean, three.half_width) == (2.0, pytest.approx(4.302653 / math.sqrt(3)))
    assert estimate([5.0]).half_width is None


def test_a_shape_without_a_surface_counts_with_its_penalty_and_is_counted(tmp_path):
    write_cell(tmp_path / "s", planned("SIREN"), [0.1e-3, None, 0.3e-3])
    group = only_group(tmp_path / "s")
    assert group.rows[0].estimate("cd_mean").mean == pytest.approx((0.1e-3 + 0.4 + 0.3e-3) / 3)
    assert group.rows[0].estimate("excess_median").mean == pytest.approx(0.25e-3)
    assert tables(group)[0].rows[0][6:8] == ["0.900", "1/3"], "normals of the two that have a surface"


def test_failed_missing_and_broken_cells_are_told_in_a_line_each(small):
    failed = planned("SIREN", "on", 0)
    broken = planned("SIREN", "on", 1)
    enter_cells(small, [failed, planned("FFT/HOSC", "on", 0)])
    (small / failed.folder).mkdir()
    (small / failed.folder / "failed.json").write_text(json.dumps({"reason": "loss is not finite at step 7"}))
    path = write_cell(small, broken, [0.1e-3]) / "metrics.json"
    path.write_text(path.read_text()[:-40])
    group = only_group(small)
    *_, table = tables(group)
    assert table.rows == [
        ["SIREN + normals, seed 0", "failed", "loss is not finite at step 7"],
        ["SIREN + normals, seed 1", "failed", "metrics.json: cannot be read (JSONDecodeError)"],
        ["FFT/HOSC + normals, seed 0", "missing", "has not been run"],
    ]
    states = {row[0]: row[8] for row in tables(group)[0].rows}
    assert (states["SIREN + normals"], states["FFT/HOSC + normals"]) == ("failed", "missing")
    html = page_of(small)
    assert "loss is not finite at step 7" in html and "has not been run" in html


WRONG = {
    "cd is a word": ("cd", "small", "known.shapes.0.cd"),
    "cd is not finite": ("cd", float("nan"), "finite"),
    "floor is missing": ("floor", None, "known.shapes.0.floor"),
}


@pytest.mark.parametrize("case", WRONG)
def test_metrics_are_checked_before_they_enter_a_mean(case, tmp_path):
    key, value, told = WRONG[case]
    folder = write_cell(tmp_path / "s", planned("SIREN"), [0.1e-3])
    metrics = json.loads((folder / "metrics.json").read_text())
    metrics["known"]["shapes"][0][key] = value
    (folder / "metrics.json").write_text(json.dumps(metrics))
    (cell,) = read_sweep(tmp_path / "s")
    assert cell.state == "failed" and told in cell.reason


def test_a_config_that_would_run_code_is_not_run(tmp_path):
    folder = write_cell(tmp_path / "s", planned("SIREN"), [0.1e-3])
    (folder / "config.yaml").write_text(f"!!python/object/apply:os.mkdir ['{tmp_path / 'pwned'}']")
    (cell,) = read_sweep(tmp_path / "s")
    assert cell.state == "failed" and "config.yaml" in cell.reason
    assert not (tmp_path / "pwned").exists()


@pytest.mark.parametrize("folder", ["../elsewhere", "/etc", "..", ".git", "a/b", ""])
def test_a_plan_cannot_point_out_of_its_folder(folder, tmp_path):
    cell = planned("SIREN").model_dump() | {"folder": folder}
    (tmp_path / PLAN).write_text(json.dumps({"version": 1, "cells": [cell]}))
    with pytest.raises(SdfhubError, match=r"cells\.0\.folder"):
        read_plan(tmp_path)


def test_a_shapes_id_cannot_point_out_of_its_folder(tmp_path):
    outside = write_mesh(tmp_path, "secret").resolve()
    folder = write_cell(tmp_path / "s", planned("SIREN"), [0.1e-3])
    (cell,) = read_sweep(tmp_path / "s")
    shape = cell.scores.shapes["known"][0]
    write_mesh(folder, "chairs/0000")
    assert reconstruction(cell.folder, "known", shape, None) is not None
    strange = shape.model_copy(update={"id": str(outside.with_suffix(""))})
    assert reconstruction(cell.folder, "known", strange, None) is None


def test_names_and_reasons_are_text_in_every_format(tmp_path):
    evil = '</script><img src=x onerror="alert(1)">{{7*7}}|$\\input{/etc/passwd}%'
    sweep = tmp_path / "s"
    write_cell(sweep, planned("SIREN", **{"data.x": evil}), [0.1e-3, 0.2e-3], ids="{:d}" + evil[:20])
    failed = planned("FFT/SIREN", **{"data.x": evil})
    enter_cells(sweep, [failed])
    (sweep / failed.folder).mkdir()
    (sweep / failed.folder / "failed.json").write_text(json.dumps({"reason": evil}))
    group = only_group(sweep)
    html = page_of(sweep, evil)
    assert "<img src=x" not in html and "onerror=&#34;" in html
    assert html.count("</script>") == 2, "the page's own two"
    assert "49" not in re.sub(r"[\d:-]+ UTC", "", html.split("<main>")[0]), "no template in a name is run"
    text = markdown(tables(group))
    assert "<img" not in text
    assert all(line.count(" | ") == text.splitlines()[2].count(" | ") for line in text.splitlines()[2:5])
    assert r"\input" not in latex(tables(group)) and r"\textbackslash{}input" in latex(tables(group))


def test_the_page_fetches_nothing_and_says_so_to_the_browser(small):
    html = page_of(small)
    assert "default-src 'none'" in html and "'sha256-" in html
    assert not re.search(r"""(?:src|href)=["'](?!data:|#)""", html)
    assert "http:" not in html and "https:" not in html


@pytest.mark.skipif(not shutil.which("pdflatex"), reason="no pdflatex on this machine")
def test_the_latex_compiles(small, tmp_path):
    enter_cells(small, [planned("SIREN", **{"loss.a_b": "50%_{x}^2~\\#&<é"})])
    text = latex([*tables(only_group(small)), claims_table(only_group(small))])
    (tmp_path / "table.tex").write_text(text)
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "table.tex"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stdout[-1500:]
    assert (tmp_path / "table.pdf").stat().st_size > 10_000


def test_printed_figures_are_the_papers():
    assert PRINTED["table_small"]["FFT/HOSC", "on"] == {"cd_mean": 0.1142e-3, "cd_median": 0.0474e-3}
    assert PRINTED["table_large"]["FFT/SIREN", "on"] == {"cd_mean": 0.0493e-3, "cd_median": 0.0249e-3}
    assert COSTS["DeepSDF", "off"]["seconds"] / COSTS["FFT/SIREN", "on"]["seconds"] == 2.5


def paper_table(sweep, name):
    """The paper's own table as a sweep of one shape each, with its Table 1 as costs."""
    for (method, normals), figures in PRINTED[name].items():
        # two shapes with a given mean and median need three: low, median, high
        mean, median = figures["cd_mean"], figures["cd_median"]
        values = [median * 0.9, median, 3 * mean - 1.9 * median]
        cost = COSTS.get((method, normals), COSTS["FFT/SIREN", "on"])
        spent = {"seconds": cost["seconds"], "parameters": int(cost["parameters"])}
        write_cell(sweep, planned(method, normals, sweep=name), values, **spent)
    return {one.claim.text: one for one in verdicts(only_group(sweep))}


@pytest.mark.parametrize("name", ["table_small", "table_large"])
def test_the_papers_own_numbers_bear_out_its_claims_but_two(name, tmp_path):
    """Its time is 0.4 of DeepSDF's, not a third, and no table shows orders of magnitude."""
    found = paper_table(tmp_path / "s", name)
    of_this_table = {claim.text for claim in CLAIMS if claim.sweep == name}
    assert of_this_table and all(found[text].state == "holds" for text in of_this_table)
    assert found["Less than a third of DeepSDF's parameters"].state == "holds"
    assert found["Less than a third of DeepSDF's training time"].state == "does not hold"
    others = {claim.text for claim in CLAIMS if claim.sweep not in ("", name)}
    assert all(found[text].state == "not tested" for text in others)
    normals = found["Normals significantly improve the accuracy of SIREN, FFT/SIREN and FFT/HOSC"]
    assert normals.state == "not tested" and "no such row: SIREN, normals off" in normals.figures


def test_a_claim_about_a_row_that_is_there_twice_says_so(tmp_path):
    for rate in ("1e-3", "1e-2"):
        write_cell(tmp_path, planned("SIREN", **{"optim.lr_codes": rate}), [0.1e-3])
    figures = {figure for one in verdicts(only_group(tmp_path)) for figure in one.figures}
    assert any(figure.startswith("several rows: SIREN") for figure in figures)


def test_a_claim_that_needs_all_fails_with_one_figure_and_is_untested_without_it(small):
    found = {one.claim.text: one for one in verdicts(only_group(small))}
    surpasses = found["With positional encoding, any periodic activation surpasses DeepSDF in mean CD"]
    assert surpasses.state == "not tested", "FFT/HOSC is not there"
    write_cell(small, planned("FFT/HOSC", "on", 0), [0.9e-3])
    found = {one.claim.text: one for one in verdicts(only_group(small))}
    surpasses = found["With positional encoding, any periodic activation surpasses DeepSDF in mean CD"]
    assert surpasses.state == "does not hold"
    assert "0.9000 not < DeepSDF 0.5000" in surpasses.figures[1]


def test_rows_of_one_method_are_told_apart_and_common_settings_stand_in_the_title(tmp_path):
    sweep = tmp_path / "s"
    for beta in ("1", "2"):
        settings = {"activation.beta": beta, "trainer.max_epochs": "3"}
        write_cell(sweep, planned("FFT/HOSC", **settings), [0.1e-3])
    group = only_group(sweep)
    labels = [row.label for row in group.rows]
    assert labels == ["FFT/HOSC + normals (activation.beta=1)", "FFT/HOSC + normals (activation.beta=2)"]
    assert group.title.endswith("trained on 1")
    assert tables(group)[0].notes[-1] == "All rows with trainer.max_epochs=3."
    for beta in ("1.2345678901", "12345678"):
        write_cell(
            sweep, planned("FFT/HOSC", **{"activation.beta": beta, "trainer.max_epochs": "3"}), [0.1e-3]
        )
    group = only_group(sweep)
    assert [row.detail for row in group.rows] == [
        f"activation.beta={b}" for b in ("1", "2", "1.23", "1.23e+07")
    ]
    assert not [table.title for table in tables(group) if "paper" in table.title], "none of these is its row"


def test_a_row_without_any_surface_is_no_ones_best_and_tests_no_claim(small):
    for normals in ("on", "off"):
        write_cell(small, planned("SIREN", normals), [None, None])
    group = only_group(small)
    rows = [row.label for row in group.rows]
    table = tables(group)[0]
    assert rows[1:3] == ["SIREN + normals", "SIREN, no normals"]
    assert not {row for row, _ in table.best} & {1, 2}
    found = {one.claim.text: one for one in verdicts(group)}
    alone = found["With a sinusoidal activation alone the method falls short of outperforming DeepSDF"]
    assert alone.state == "not tested" and "no shape has a surface: SIREN + normals" in alone.figures


def test_rows_that_are_equally_good_are_both_the_best(tmp_path):
    for method in ("SIREN", "FFT/SIREN"):
        write_cell(tmp_path, planned(method), [0.1e-3, 0.2e-3])
    assert {row for row, _ in tables(only_group(tmp_path))[0].best} == {0, 1}


def test_seconds_of_training_test_no_claim(tmp_path):
    for method, normals in (("DeepSDF", "off"), ("FFT/SIREN", "on"), ("FFT/HOSC", "on")):
        write_cell(tmp_path, planned(method, normals, sweep="smoke"), [0.1e-3])
    assert {one.state for one in verdicts(only_group(tmp_path))} == {"not tested"}


def test_a_cell_under_new_defaults_replaces_its_old_one_in_the_plan(tmp_path):
    old = planned("SIREN")
    enter_cells(tmp_path, [old, planned("FFT/SIREN")])
    enter_cells(tmp_path, [old.model_copy(update={"folder": "new"})])
    assert [cell.folder for cell in read_plan(tmp_path).cells] == ["new", planned("FFT/SIREN").folder]


def test_a_report_says_how_its_sweep_was_made(tmp_path):
    first = "python train.py -m sweeps=table_small"
    second = f"{first} 'data.x=[1, 2]'"
    with_ = {"torch": "2.13.0", "device": "Some CPU | 3"}
    write_cell(tmp_path, planned("SIREN", seed=0), [0.1e-3], seconds=200, made_with=with_)
    write_cell(tmp_path, planned("SIREN", seed=1), [0.1e-3], seconds=100, made_with=with_)
    write_cell(tmp_path, planned("DeepSDF", "off"), [0.1e-3], seconds=3300)
    for command in (first, second, first):
        enter_cells(tmp_path, [planned("FFT/HOSC")], command)
    assert origin_table(read_plan(tmp_path).commands, read_sweep(tmp_path)).rows == [
        ["command", first],
        ["command", second],
        ["trainings", "3 of 4 done, 60.0 min in all"],
        ["2 of them with", "torch 2.13.0, device Some CPU | 3"],
        ["1 of them with", "not written down"],
    ]
    html = page_of(tmp_path)
    assert "data.x=[1, 2]" in html and "Some CPU | 3" in html


def test_augmented_copies_are_drawn_from_and_not_shapes(tmp_path):
    folder = write_cell(tmp_path, planned("SIREN"), [0.1e-3, 0.1e-3, 0.1e-3])
    config = yaml.safe_load((folder / "config.yaml").read_text())
    config["data"]["loader"]["augmentation"] = {"copies": 2}
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    (cell,) = read_sweep(tmp_path)
    assert (cell.scores.trained_on, cell.scores.samples) == (3, 50 * 9 * 256)


def test_what_was_judged_by_distances_alone_has_a_table_of_its_own(tmp_path):
    for method, normals, errors in (("DeepSDF", "off", (0.2, 0.4)), ("SIREN", "on", (0.1, 0.1))):
        folder = write_cell(tmp_path, planned(method, normals), [0.1e-3])
        metrics = json.loads((folder / "metrics.json").read_text())
        rows = [{"id": str(error), "sdf_error": error, "sign_accuracy": 1 - error} for error in errors]
        metrics |= {"held_out": {"summary": {}, "shapes": rows}}
        del metrics["known"]
        (folder / "metrics.json").write_text(json.dumps(metrics))
    group = only_group(tmp_path)
    distances, cost = tables(group)
    assert distances.title.startswith("Held-out shapes, signed distances")
    assert distances.rows == [
        ["DeepSDF", "300.00", "300.00", "0.7000", "1/1", "1"],
        ["SIREN + normals", "100.00", "100.00", "0.9000", "1/1", "0.333"],
    ]
    assert cost.rows[0][1] == "1"
    assert {one.state for one in verdicts(group)} == {"not tested"}
    assert "no figure of: SIREN + normals" in str([one.figures for one in verdicts(group)])
    assert "signs right" in page_of(tmp_path)
    line = next(csv.DictReader(csv_text([group]).splitlines()))
    assert (line["role"], line["cd_mean"]) == ("known", "")


def test_a_lock_is_held_once_and_freed(tmp_path):
    path = tmp_path / ".lock"
    with locked(path, patience=0) as first, locked(path, patience=0.2) as second:
        assert (first, second) == (True, False)
    with locked(path, patience=0) as third:
        assert third


def test_packed_meshes_unpack_to_the_same_places_within_a_step():
    import base64

    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.9)
    mesh = Mesh(np.asarray(ball.vertices), np.asarray(ball.faces), "y")
    found = packed(mesh, triangles=10_000)
    content = base64.b64decode(found["data"])
    places = np.frombuffer(content, "<i2", found["vertices"] * 3).reshape(-1, 3) / 32767
    faces = np.frombuffer(content, "<u2", offset=found["vertices"] * 6).reshape(-1, 3)
    turned = np.column_stack([mesh.vertices[:, 0], -mesh.vertices[:, 2], mesh.vertices[:, 1]])
    np.testing.assert_allclose(places, turned, atol=1e-4)
    np.testing.assert_array_equal(faces, mesh.faces)
    assert packed(mesh, triangles=100)["faces"] <= 110


def test_other_processes_draw_and_read_the_same(small, monkeypatch):
    """The plain twin of drawing in processes is drawing here."""
    for cell in read_sweep(small):
        write_mesh(cell.folder, "chairs/0000")
        with SummaryWriter(cell.folder / "tensorboard") as writer:
            for step in range(9):
                writer.add_scalar("loss/sdf", 0.1 / (1 + step + cell.plan.seed), step)
    found = []
    for worth in (1000, 1):
        monkeypatch.setattr(pictures, "A_WORKERS_WORTH", worth)
        monkeypatch.setattr(curves, "A_WORKERS_WORTH", worth)
        found.append(re.sub("20[0-9-]+ [0-9:]+ UTC", "", page_of(small)))
    assert found[0] == found[1]
    assert "data:image/webp" in found[0] and "Loss of signed distances" in found[0]


def test_the_command_takes_a_folder_of_any_name_and_writes_its_files(small, monkeypatch, tmp_path, capsys):
    strange = small.rename(tmp_path / "it's, a=[sweep] $x")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["sdfhub report", str(strange), "shapes=2"])
    report_task.main()
    written = {path.name for path in (strange / "report").iterdir()}
    sheet = "sheet_table_small_procedural_chairs_cpu.png"
    assert written == {"table.md", "table.tex", "table.csv", "shapes.csv", "report.html", sheet}
    assert "DeepSDF" in capsys.readouterr().out


def test_a_report_says_what_failed_and_that_only_a_sweep_tries_it_again(tmp_path, capsys):
    for name, more, end in (
        ("table", {}, "; the command of the sweep tries them again"),
        ("search", {"search": "siren"}, ""),
    ):
        good, bad = planned("SIREN"), planned("SIREN", seed=1)
        good, bad = (cell.model_copy(update={"choices": cell.choices | more}) for cell in (good, bad))
        write_cell(tmp_path / name, good, [0.1e-3])
        enter_cells(tmp_path / name, [bad])
        (tmp_path / name / bad.folder).mkdir()
        (tmp_path / name / bad.folder / "failed.json").write_text('{"reason": "diverged", "traceback": ""}')
        report_task.report({"sweep": str(tmp_path / name), "out": None, "shapes": 1})
        assert capsys.readouterr().err.strip() == f"sdfhub: 1 of 2 cells failed{end}"


def test_what_is_no_sweep_gets_no_folder(tmp_path):
    with pytest.raises(SdfhubError, match="not the folder of a multirun"):
        report_task.report({"sweep": str(tmp_path / "nothere"), "out": None, "shapes": 2})
    assert not list(tmp_path.iterdir())


def test_what_is_no_sweep_is_one_line(tmp_path):
    with pytest.raises(SdfhubError, match="not the folder of a multirun"):
        write_report(tmp_path, tmp_path / "report")
    (tmp_path / PLAN).write_text("{}}")
    with pytest.raises(SdfhubError, match=r"sweep\.json"):
        write_report(tmp_path, tmp_path / "report")


def test_scores_are_what_training_writes():
    from sdfhub.geometry.metrics import ShapeMetrics
    from sdfhub.report.results import ShapeScore

    assert set(ShapeScore.model_fields) - {"id"} <= set(ShapeMetrics.__dataclass_fields__)
    assert set(score("x", 1.0)) - {"id"} <= set(ShapeMetrics.__dataclass_fields__)


def test_a_significant_difference_needs_intervals_apart_and_noise_is_said(tmp_path):
    text = "Normals significantly improve the accuracy of SIREN, FFT/SIREN and FFT/HOSC"
    for name, spread, state in (("far", 0.01, "holds"), ("near", 0.5, "does not hold")):
        for method in ("SIREN", "FFT/SIREN", "FFT/HOSC"):
            for seed, shift in enumerate((-spread, 0, spread)):
                for normals, cd in (("on", 1e-3), ("off", 1.5e-3)):
                    write_cell(tmp_path / name, planned(method, normals, seed), [cd * (1 + shift)])
        found = {one.claim.text: one for one in verdicts(only_group(tmp_path / name))}
        assert found[text].state == state
        assert found["Positional encoding counters the overfitting of periodic activations alone"].state == (
            "not tested"
        )
    for normals, seed, cd in (("off", 0, 1e-3), ("off", 1, 3e-3)):
        write_cell(tmp_path / "near", planned("DeepSDF", normals, seed), [cd])
    found = {one.claim.text: one for one in verdicts(only_group(tmp_path / "near"))}
    surpasses = found["With positional encoding, any periodic activation surpasses DeepSDF in mean CD"]
    assert (surpasses.state, surpasses.within_noise) == ("holds", True)


def test_a_share_of_nothing_decides_no_claim(tmp_path):
    """Excess can fall below 0 by chance, where a smaller share of it is more."""
    for method, excess in (("DeepSDF", -4e-7), ("FFT/SIREN", -2e-7), ("FFT/HOSC", -3e-7)):
        write_cell(tmp_path, planned(method, "off" if method == "DeepSDF" else "on"), [0.05e-3 + excess])
    shares = [one for one in verdicts(only_group(tmp_path)) if any("share of" in f for f in one.figures)]
    assert shares and not any(one.state == "holds" for one in shares)


def test_a_verdict_that_one_clear_comparison_settles_is_no_noise(tmp_path):
    text = "FFT/HOSC has the lowest mean CD"
    for method, cd, spread in (
        ("FFT/HOSC", 1e-3, 1e-5),
        ("DeepSDF", 1e-4, 1e-6),
        ("FFT/SIREN", 0.999e-3, 1e-5),
    ):
        for seed, shift in enumerate((-spread, 0, spread)):
            normals = "off" if method == "DeepSDF" else "on"
            write_cell(tmp_path, planned(method, normals, seed), [cd + shift])
    (found,) = [one for one in verdicts(only_group(tmp_path)) if text in one.claim.text][:1]
    assert (found.state, found.within_noise) == ("does not hold", False)


def test_seeds_trained_under_other_defaults_are_rows_of_their_own(tmp_path):
    """A new version's defaults change a cell that the same command line asks for."""
    for seed, tau in ((0, 0.088), (1, 0.0126), (2, 0.0126)):
        config = {"seed": seed, "normals": {"tau": tau}, "loss": {"tau": tau}, "output_root": f"o{seed}"}
        write_cell(tmp_path, planned("FFT/SIREN", seed=seed), [1e-3 * (seed + 1)], config=config)
    enter_cells(tmp_path, [planned("FFT/SIREN", seed=3)])
    group = only_group(tmp_path)
    assert [(row.detail, len(row.done), len(row.cells)) for row in group.rows] == [
        ("loss.tau=0.088", 1, 1),
        ("loss.tau=0.0126", 2, 3),
    ]
    assert group.rows[1].estimate("cd_mean").mean == pytest.approx(2.5e-3)


def test_other_shapes_and_other_ways_of_judging_are_other_groups_with_names_of_their_own(tmp_path):
    shapes = [{"data.shapes": "8"}, {"data.shapes": "20"}, {"scale.small_table": "9"}]
    for settings in (*shapes, {"evaluate.resolution": "64"}):
        write_cell(tmp_path, planned("SIREN", **settings), [0.1e-3])
    write_cell(tmp_path, planned("SIREN", **{"data.loader.samples_per_shape": "9"}), [0.1e-3])
    groups = group_cells(read_sweep(tmp_path))
    assert [group.title for group in groups] == [
        "chairs, data=procedural, scale=cpu, data.shapes=8, trained on 1",
        "chairs, data=procedural, scale=cpu, data.shapes=20, trained on 1",
        "chairs, data=procedural, scale=cpu, scale.small_table=9, trained on 1",
        "chairs, data=procedural, scale=cpu, evaluate.resolution=64, trained on 1",
        "chairs, data=procedural, scale=cpu, trained on 1",
    ]
    write_report(tmp_path, tmp_path / "report")
    assert len(list((tmp_path / "report").glob("sheet_*.png"))) == 5
    fits = [
        planned("SIREN").model_copy(
            update={"choices": planned("SIREN").choices | {"fit": fit}, "folder": fit}
        )
        for fit in ("deepsdf", "gauss_newton")
    ]
    for cell in fits:
        write_cell(tmp_path / "fits", cell, [0.1e-3], [0.2e-3])
    groups = group_cells(read_sweep(tmp_path / "fits"))
    assert len(groups) == len({group.title for group in groups}) == len({sheet_name(g) for g in groups}) == 2
    assert {line["fit"] for line in csv.DictReader(csv_text(groups).splitlines())} == {
        "deepsdf",
        "gauss_newton",
    }


def test_sheets_of_long_and_of_odd_settings_have_names_of_their_own(tmp_path):
    roots = [f"/mnt/{'deep/' * 50}{name}" for name in ("a", "b")]
    for key, values in {"data.source.root": roots, "data.source.names": ["[a,b]", "[a-b]"]}.items():
        for k, value in enumerate(values):
            cell = planned("SIREN").model_copy(update={"settings": {key: value}, "folder": f"{key}{k}"})
            write_cell(tmp_path, cell, [0.1e-3])
    names = {sheet_name(group) for group in group_cells(read_sweep(tmp_path))}
    assert len(names) == 4 and all(len(name) < 200 for name in names)


def test_a_default_that_is_said_later_leaves_a_row_its_name(tmp_path):
    plain, said = planned("FFT/SIREN"), planned("FFT/SIREN", decoder="small")
    enter_cells(tmp_path, [plain, planned("SIREN")])
    enter_cells(tmp_path, [said.model_copy(update={"folder": plain.folder})])
    assert [cell.settings for cell in read_plan(tmp_path).cells] == [{}, {}]


def test_several_tables_have_one_before_them_and_every_shape_a_line(tmp_path):
    lamps = {"choices": planned("SIREN").choices | {"category": "lamps"}, "folder": "lamps"}
    write_cell(tmp_path, planned("FFT/SIREN"), [0.15e-3, 0.25e-3, 0.65e-3])
    write_cell(tmp_path, planned("SIREN", seed=0), [0.15e-3], [0.55e-3])
    write_cell(tmp_path, planned("SIREN", seed=1), [0.35e-3], [None])
    write_cell(tmp_path, planned("SIREN").model_copy(update=lamps), [0.06e-3, None])
    groups = group_cells(read_sweep(tmp_path))
    known, held_out = overview(groups)
    assert known.head == ["method", "chairs, trained on 1 to 3", "lamps, trained on 2"]
    assert [row[:2] for row in known.rows] == [
        ["SIREN + normals", "0.2000, 0.2000 (2)"],
        ["FFT/SIREN + normals", "0.3000, 0.2000"],
    ]
    assert [row[2] for row in known.rows] == ["199.98, 199.98", "–"]
    assert [row[1:] for row in held_out.rows] == [["200.23, 200.23 (2)", "–"], ["–", "–"]]
    assert overview(groups[:1]) == []
    lines = list(csv.DictReader(shapes_csv(groups).splitlines()))
    assert len(lines) == 3 + 4 + 2
    (lost,) = [line for line in lines if line["role"] == "held_out" and line["seed"] == "1"]
    assert (lost["shape"], lost["cd"], float(lost["excess"])) == (
        "chairs/0100",
        "",
        pytest.approx(0.4 - 5e-5),
    )
    html = page_of(tmp_path)
    assert html.count("<h2>All tables</h2>") == 1 and "199.98, 199.98" in html


def test_fields_that_have_not_learnt_their_shapes_decide_no_claim(tmp_path):
    write_cell(tmp_path, planned("DeepSDF", "off"), [0.4])
    write_cell(tmp_path, planned("FFT/SIREN"), [0.3])
    write_cell(tmp_path, planned("FFT/HOSC"), [0.02])
    found = {one.claim.text: one for one in verdicts(only_group(tmp_path))}
    surpasses = found["With positional encoding, any periodic activation surpasses DeepSDF in mean CD"]
    assert surpasses.told == "not tested" and surpasses.figures[0].startswith("neither is near its shapes")


def test_what_must_be_significant_needs_seeds(tmp_path):
    for normals, cds in {"on": [0.1e-3, 0.11e-3], "off": [0.3e-3, 0.31e-3]}.items():
        for seed, cd in enumerate(cds):
            for method in ("SIREN", "FFT/SIREN", "FFT/HOSC"):
                write_cell(tmp_path, planned(method, normals, seed), [cd])
            found = {one.claim.text: one for one in verdicts(only_group(tmp_path))}
            claim = found["Normals significantly improve the accuracy of SIREN, FFT/SIREN and FFT/HOSC"]
            assert claim.told == ("holds" if (normals, seed) == ("off", 1) else "not tested")


def test_each_row_is_measured_by_the_deepsdf_of_its_own_settings(tmp_path):
    for epochs, own, rival in (("5", 0.3e-3, 0.55e-3), ("9", 0.2e-3, 0.65e-3)):
        write_cell(tmp_path, planned("SIREN", **{"trainer.max_epochs": epochs}), [own])
        write_cell(tmp_path, planned("DeepSDF", "off", **{"trainer.max_epochs": epochs}), [rival])
    rows = {row[0]: row[-1] for row in tables(only_group(tmp_path))[0].rows}
    assert rows["SIREN + normals (trainer.max_epochs=5)"] == "0.5"
    assert rows["SIREN + normals (trainer.max_epochs=9)"] == "0.25"


def test_rows_of_the_csv_say_which_shapes_they_are_judged_by(tmp_path):
    for split in "01":
        write_cell(tmp_path, planned("SIREN", **{"data.split_seed": split}), [0.1e-3])
    lines = csv.DictReader(csv_text(group_cells(read_sweep(tmp_path))).splitlines())
    assert {line["settings"] for line in lines} == {"data.split_seed=0", "data.split_seed=1"}


def test_a_verdict_of_one_seed_says_so_and_parameters_need_no_seeds(tmp_path):
    for method, cd, parameters in (
        ("DeepSDF", 0.5e-3, 4000),
        ("FFT/SIREN", 0.2e-3, 9),
        ("FFT/HOSC", 0.1e-3, 9),
    ):
        normals = "off" if method == "DeepSDF" else "on"
        write_cell(tmp_path, planned(method, normals), [cd], parameters=parameters)
    found = {one.claim.text: one for one in verdicts(only_group(tmp_path))}
    assert found["Less than a third of DeepSDF's parameters"].told == "holds"
    assert found["Less than a third of DeepSDF's training time"].told == "does not hold (one seed)"
    surpasses = found["With positional encoding, any periodic activation surpasses DeepSDF in mean CD"]
    assert surpasses.told == "holds (one seed)"
    assert "on 1 shapes, the paper's table on 100" in surpasses.figures
    lowest = found["FFT/HOSC has the lowest mean CD of the small table"]
    assert lowest.told == "not tested", "SIREN is not there"


def test_a_difference_below_the_noise_of_sampling_decides_nothing(tmp_path):
    for method, cd in (
        ("DeepSDF", 0.3e-3),
        ("SIREN", 0.2e-3),
        ("FFT/SIREN", 0.1e-3),
        ("FFT/HOSC", 0.0995e-3),
    ):
        write_cell(tmp_path, planned(method, "off" if method == "DeepSDF" else "on"), [cd])
    found = {one.claim.text: one for one in verdicts(only_group(tmp_path))}
    lowest = found["FFT/HOSC has the lowest mean CD of the small table"]
    assert lowest.state == "not tested" and any("noise of sampling" in figure for figure in lowest.figures)


def test_truth_is_looked_up_where_the_cell_was_trained(tmp_path):
    """Two sources may give two shapes one id."""
    folders = [write_cell(tmp_path, planned(method), [0.1e-3]) for method in ("SIREN", "FFT/SIREN")]
    asked = []
    gallery = Gallery(lambda cell, id: asked.append((cell.folder, id)))
    group = only_group(tmp_path)
    gallery.sheet(group, 1)
    gallery.extremes(group)
    assert {folder for folder, _ in asked} == set(folders)
