"""The smoke sweep as a user runs it: killed, started again, and its page looked at in a real browser."""

import re
import time

import pytest

from sdfhub.report.results import read_sweep
from sdfhub.report.rows import group_cells
from tests.browser import empty_page
from tests.commands import Command
from tests.test_notebooks import NOTEBOOKS, kernel, run_notebook  # noqa: F401


@pytest.fixture(scope="module")
def smoked(tmp_path_factory) -> dict:
    """The smoke sweep as a user runs it: killed in its second cell, started again, run to its report."""
    root = tmp_path_factory.mktemp("smoke")
    outputs = root / "outputs" / "notebooks"
    words = ["-m", "sweeps=smoke", f"paths.output={outputs}", f"data.store={outputs / 'store'}"]
    sweep = outputs / "sweeps" / "smoke"
    killed = Command(*words).process
    while killed.exitcode is None and not any(sweep.glob("*seed-1*/checkpoints/last.ckpt")):
        time.sleep(0.05)
    killed.kill()
    killed.join()
    states = [cell.state for cell in read_sweep(sweep)]
    (first,) = sweep.glob("*/metrics.json")
    written = first.stat().st_mtime_ns
    Command(*words).output()
    return {"root": root, "sweep": sweep, "states": states, "first": first, "written": written}


def test_the_smoke_sweep_killed_halfway_goes_on_to_its_report(smoked):
    sweep = smoked["sweep"]
    assert smoked["states"] == ["done", "missing", "missing", "missing"]
    assert smoked["first"].stat().st_mtime_ns == smoked["written"], "a finished cell is not repeated"
    cells = read_sweep(sweep)
    assert [cell.state for cell in cells] == ["done"] * 4
    continued = [cell.plan.seed for cell in cells if cell.scores.config["ckpt_path"]]
    assert continued == [1], "the interrupted cell goes on from its last checkpoint"
    (group,) = group_cells(cells)
    assert [row.label for row in group.rows] == ["DeepSDF", "FFT/SIREN + normals"]
    for row in group.rows:
        assert [cell.scores.training.steps for cell in row.done] == [40, 40]
        assert group.statistics.loc[row.label, "train"]["cd_mean_seeds"] == 2
    assert "python train.py -m sweeps=smoke" in (sweep / "report" / "table.md").read_text()
    for name in ("table.md", "table.tex", "table.csv"):
        assert "FFT/SIREN" in (sweep / "report" / name).read_text()


def test_the_notebook_about_sweeps_runs_and_finds_this_one_finished(smoked, kernel, monkeypatch):  # noqa: F811
    run_notebook(NOTEBOOKS[-1], smoked["root"] / "notebooks", kernel, monkeypatch)
    assert smoked["first"].stat().st_mtime_ns == smoked["written"]


@pytest.fixture(scope="module")
def opened(smoked):
    """The smoke sweep's page in a headless browser, and all it said and asked for."""
    with empty_page(1280, 900) as page:
        page.goto((smoked["sweep"] / "report" / "report.html").as_uri())
        page.wait_for_selector("[data-drawn]", timeout=20_000)
        yield page


def test_the_page_renders_in_a_browser_without_errors_or_requests(opened):
    opened.screenshot(full_page=True)
    assert opened.said == []
    assert [url for url in opened.asked if not url.startswith("data:")] == [opened.url]
    headings = opened.locator("h3").all_inner_texts()
    assert headings[:2] == ["Training shapes", "Held-out shapes"] and "Settings that differ" in headings
    broken = "[...document.images].filter(i => !i.complete || !i.naturalWidth).length"
    assert opened.evaluate(broken) == 0 and opened.evaluate("document.images.length") >= 9
    overflow = "document.documentElement.scrollWidth > document.documentElement.clientWidth"
    assert not opened.evaluate(overflow), "tables scroll in their own frame"


def test_meshes_turn_together_under_the_mouse(opened):
    pictures = "[...document.querySelectorAll('canvas')].map(c => c.toDataURL())"
    inked = """[...document.querySelectorAll('canvas')].map(c => c.getContext('2d')
        .getImageData(0, 0, c.width, c.height).data.filter((v, k) => k % 4 === 3 && v > 0).length)"""
    assert min(opened.evaluate(inked)) > 100, "every panel shows something"
    before = opened.evaluate(pictures)
    box = opened.locator("canvas").first
    box.scroll_into_view_if_needed()
    place = box.bounding_box()
    opened.mouse.move(place["x"] + 60, place["y"] + 60)
    opened.mouse.down()
    opened.mouse.move(place["x"] + 120, place["y"] + 70, steps=4)
    opened.mouse.up()
    opened.wait_for_timeout(200)
    after = opened.evaluate(pictures)
    assert len(after) == len(before) >= 2
    assert all(a != b for a, b in zip(after, before, strict=True))
    opened.locator(".choices button").nth(1).click()
    opened.wait_for_timeout(200)
    assert opened.evaluate(pictures)[0] != after[0]
    assert opened.said == []


def test_an_injected_script_does_not_run(opened):
    opened.evaluate("""() => {
        const script = document.createElement('script');
        script.textContent = 'window.injected = 1';
        document.body.append(script);
    }""")
    assert opened.evaluate("window.injected") is None
    assert any(re.search("Content Security Policy", text) for _, text in opened.said)
