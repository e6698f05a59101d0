"""The viewer's page in a headless browser."""

import io
from urllib.parse import urlsplit

import numpy as np
import pytest
from PIL import Image

import sdfhub
from sdfhub.viewer.page import Viewer
from tests.ball_space import IDS, write_ball_run
from tests.browser import empty_page
from tests.test_view import ball_file, wait_until

READY = "text => document.querySelector('.sdfhub-name')?.textContent === text"


@pytest.fixture(scope="module")
def viewer(tmp_path_factory):
    run = write_ball_run(tmp_path_factory.mktemp("view") / "balls")
    viewer = Viewer(sdfhub.load(run, device="cpu"), "balls", 0, 32)
    viewer.server.scene.configure_default_lights(cast_shadow=False)  # most of a frame without a GPU
    yield viewer
    viewer.close()


@pytest.fixture(scope="module")
def opened(viewer):
    """The page in a headless browser, and all it said and asked for."""
    with empty_page(640, 720) as page:
        page.set_default_timeout(60_000)
        # a quarter of the pixels a side
        page.goto(f"http://127.0.0.1:{viewer.server.get_port()}/?fixedDpr=0.25")
        page.wait_for_function(READY, arg=IDS[0])
        yield page


def wrong(page) -> list[str]:
    """The errors that a page told."""
    return [text for kind, text in page.said if kind == "error"]


def test_the_page_renders_without_errors_and_asks_nobody_but_this_machine(opened):
    assert opened.get_by_text("Principal directions").is_visible()
    assert opened.get_by_text("4 shapes, codes of 4 numbers").is_visible()
    assert opened.get_by_role("slider").count() == 1 + 3, "A to B, and as many axes as four codes have"
    assert opened.locator("canvas").first.bounding_box()["height"] > 500
    remote = [url for url in opened.asked if urlsplit(url.removeprefix("blob:")).hostname != "127.0.0.1"]
    assert [url for url in remote if not url.startswith("data:")] == [] and len(opened.asked) >= 2
    assert wrong(opened) == []


def test_a_page_that_tried_to_reach_another_host_could_not(opened):
    attempt = "url => fetch(url).then(() => 'reached', () => 'refused')"
    assert opened.evaluate(attempt, "http://localhost:1/") == "refused"
    assert any("Content Security Policy" in said for said in wrong(opened))
    opened.said.clear()


def picture(page) -> np.ndarray:
    """What can be seen beside the controls and below viser's notices, as [H, W] grey values."""
    content = page.screenshot(clip={"x": 0, "y": 260, "width": 300, "height": 400}, timeout=120_000)
    return np.asarray(Image.open(io.BytesIO(content)).convert("L"), dtype=float)


def test_a_slider_changes_the_mesh_in_the_page(opened, viewer):
    before, seen = viewer.mesh.vertices.copy(), picture(opened)
    opened.get_by_role("slider").nth(1).focus()
    opened.keyboard.press("Home")  # the other end of this slider has no surface
    opened.wait_for_function(READY, arg=f"{IDS[0]}, moved")
    wait_until(lambda: viewer.sliders[0].value == pytest.approx(-3.0))
    assert not np.array_equal(before, viewer.mesh.vertices)
    wait_until(lambda: (np.abs(picture(opened) - seen) > 20).mean() > 0.03, seconds=60)


def test_a_dropped_file_is_fitted_and_shown(opened, tmp_path):
    file = tmp_path / "scan of a ball.ply"
    file.write_bytes(ball_file())
    box = opened.get_by_text("Drop a scan here").bounding_box()
    devtools = opened.context.new_cdp_session(opened)
    what = {"items": [], "files": [str(file)], "dragOperationsMask": 1}
    place = {"x": box["x"] + box["width"] / 2, "y": box["y"] + box["height"] / 2}
    for kind in ("dragEnter", "dragOver", "drop"):
        devtools.send("Input.dispatchDragEvent", {"type": kind, **place, "data": what})
    opened.wait_for_function(READY, arg=file.name)
    assert opened.get_by_text("off the fitted one").is_visible()
    assert wrong(opened) == []
