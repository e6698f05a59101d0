"""The viewer without a browser: what the page shows and when, and what it does with a dropped file."""

import sys
import threading
import time

import numpy as np
import pytest
import torch
import trimesh

import sdfhub
from sdfhub.errors import SdfhubError
from sdfhub.scans.scan import read_scan
from sdfhub.space import reconstruct
from sdfhub.tasks import view as view_task
from sdfhub.viewer.live_meshing import LiveMesher, Meshed
from sdfhub.viewer.page import MEAN, Viewer, fit_scan, paragraph
from tests.ball_space import IDS, RADII, write_ball_run
from tests.tiny import composed


class Ball(torch.nn.Module):
    """A ball whose radius is the code; waits before each evaluation until it may go on."""

    def __init__(self):
        super().__init__()
        self.may_go_on, self.evaluations = threading.Event(), 0
        self.may_go_on.set()

    def forward(self, points, codes):
        self.evaluations += 1
        assert self.may_go_on.wait(20)
        return points.norm(dim=-1) - codes


def radius(found: Meshed) -> float:
    return float(np.linalg.norm(found.mesh[0], axis=1).mean())


def wait_until(condition, seconds=20.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.01)


@pytest.fixture
def ball_mesher():
    ball, shown = Ball(), []
    mesher = LiveMesher(ball, [16, 24], shown.append)
    yield ball, mesher, shown
    ball.may_go_on.set()
    mesher.close()


def test_of_many_codes_only_the_first_and_the_last_are_meshed_and_the_last_finely(ball_mesher):
    ball, mesher, shown = ball_mesher
    ball.may_go_on.clear()
    mesher.ask(torch.tensor([0.3]), "first")
    wait_until(lambda: ball.evaluations)
    for size in torch.linspace(0.4, 0.8, 9):
        mesher.ask(size[None], "later")
    ball.may_go_on.set()
    wait_until(lambda: len(shown) == 3)
    assert [(found.about, found.resolution) for found in shown] == [
        ("first", 16),
        ("later", 16),
        ("later", 24),
    ]
    assert [radius(found) for found in shown] == pytest.approx([0.3, 0.8, 0.8], abs=0.01)


def test_a_finer_mesh_is_given_up_for_a_newer_code(ball_mesher):
    _, mesher, shown = ball_mesher
    reached, answered = threading.Event(), threading.Event()

    def show(found):
        shown.append(found)
        if len(shown) == 1:  # in the mesher's thread, before its finer mesh begins
            reached.set()
            answered.wait(20)

    mesher.show = show
    mesher.ask(torch.tensor([0.3]))
    assert reached.wait(20)
    mesher.ask(torch.tensor([0.5]))
    answered.set()
    wait_until(lambda: len(shown) == 3)
    assert [found.resolution for found in shown] == [16, 16, 24]
    assert radius(shown[2]) == pytest.approx(0.5, abs=0.01)


def test_a_field_without_numbers_is_told_and_the_next_code_is_meshed(ball_mesher):
    _, mesher, shown = ball_mesher
    mesher.ask(torch.tensor([torch.nan]))
    wait_until(lambda: shown)
    assert isinstance(shown[0], SdfhubError) and "not finite" in str(shown[0])
    mesher.ask(torch.tensor([0.5]))
    wait_until(lambda: len(shown) == 3)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return write_ball_run(tmp_path_factory.mktemp("view") / "balls")


@pytest.fixture(scope="module")
def space(run):
    return sdfhub.load(run, device="cpu")


@pytest.fixture(scope="module")
def viewer(space):
    viewer = Viewer(space, "balls", 0, 32)
    assert viewer.drawn.wait(30)
    yield viewer
    viewer.close()


def test_a_mesh_that_fails_is_told_and_the_next_one_comes(ball_mesher):
    _, mesher, shown = ball_mesher
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(Ball, "forward", lambda *_: torch.empty(2**62))
        mesher.ask(torch.tensor([0.3]))
        wait_until(lambda: shown)
    assert isinstance(shown[0], SdfhubError) and "RuntimeError" in str(shown[0])
    mesher.ask(torch.tensor([0.5]))
    wait_until(lambda: len(shown) == 3)
    assert radius(shown[-1]) == pytest.approx(0.5, abs=0.01)


def size_shown(viewer) -> float:
    return float(np.linalg.norm(viewer.mesh.vertices, axis=1).mean())


def shows(viewer, name: str):
    wait_until(lambda: paragraph(name, "name") in viewer.name.content)


def test_the_live_mesh_is_the_spaces_mesh(space):
    shown = []
    mesher = LiveMesher(space.decoder, [32], shown.append)
    mesher.ask(space.code(0))
    wait_until(lambda: shown)
    mesher.close()
    plain = next(reconstruct(space.decoder, space.codes[:1], 32))
    for live, twin in zip(shown[0].mesh, plain, strict=True):
        np.testing.assert_array_equal(live, twin)


def test_the_page_shows_a_shape_goes_to_another_and_comes_back(viewer):
    assert set(viewer.shapes) == {*IDS, MEAN}
    for id, size in zip(IDS, RADII, strict=True):
        viewer.a.value = id
        shows(viewer, id)
        assert size_shown(viewer) == pytest.approx(size, abs=0.02)
    viewer.b.value, viewer.share.value = IDS[0], 1.0
    shows(viewer, f"{IDS[3]} → {IDS[0]}, 1.00")
    assert size_shown(viewer) == pytest.approx(RADII[0], abs=0.02)
    viewer.sliders[0].value = 0.5
    shows(viewer, f"{IDS[3]} → {IDS[0]}, 1.00, moved")
    viewer.reset()
    shows(viewer, IDS[3])
    assert [slider.value for slider in (viewer.share, *viewer.sliders)] == [0.0] * (1 + len(viewer.sliders))


def test_the_page_refines_what_rests(space):
    viewer = Viewer(space, "balls", 0, 96)
    try:
        assert viewer.mesher.resolutions == (64, 96)
        wait_until(lambda: "96³" in viewer.name.content)
    finally:
        viewer.close()


def test_a_slider_moves_by_standard_deviations_along_a_principal_axis(viewer, space):
    asked = []
    viewer.a.value = IDS[1]
    shows(viewer, IDS[1])
    wanted = viewer.mesher.ask
    try:
        viewer.mesher.ask = lambda code, about: asked.append(code)
        viewer.sliders[1].value = -1.5
        wait_until(lambda: asked)
    finally:
        viewer.mesher.ask = wanted
    torch.testing.assert_close(asked[-1], space.code(IDS[1]) - 1.5 * space.principal_directions[1])
    viewer.reset()


@pytest.mark.parametrize("value", [1e308, float("nan"), float("inf"), -3.5])
def test_a_number_that_no_slider_has_moves_nothing(viewer, value):
    viewer.a.value = IDS[0]
    viewer.sliders[0].value = value
    viewer.share.value = value
    shows(viewer, IDS[0])
    viewer.reset()


def ball_file(size=0.5, kind="ply") -> bytes:
    content = trimesh.creation.icosphere(subdivisions=4, radius=4 * size).export(file_type=kind)
    return content.encode() if isinstance(content, str) else content


def test_a_mesh_is_fitted_offered_and_shown_with_its_points(viewer, space):
    viewer.fit("C:\\scans\\my ball.ply", ball_file())
    shows(viewer, "my ball.ply")
    assert "my ball.ply" in viewer.a.options and "my ball.ply" in viewer.b.options
    assert viewer.scan.visible
    np.testing.assert_allclose(np.linalg.norm(viewer.scan.points, axis=1), 1 / 1.03, atol=0.01)
    assert "off the fitted one" in viewer.message.content
    assert "Doubtful" in viewer.message.content, "its radius is twice that of any ball of the space"
    viewer.a.value = IDS[0]
    shows(viewer, IDS[0])
    wait_until(lambda: not viewer.scan.visible)


def cloud_file() -> bytes:
    points = trimesh.creation.icosphere(subdivisions=4, radius=3.0).vertices + [5.0, 0, 0]
    return "\n".join(" ".join(map(str, point)) for point in points).encode()


@pytest.mark.parametrize(
    ("name", "content"), [("ball.obj", ball_file(kind="obj")), ("ball.xyz", cloud_file())]
)
def test_a_mesh_or_cloud_is_fitted_as_the_space_fits_it_in_its_own_frame(space, name, content, tmp_path):
    (tmp_path / name).write_bytes(content)
    code, surface = fit_scan(space, name, content)
    torch.testing.assert_close(code, space.fit_scan(read_scan(tmp_path / name)))
    assert len(surface) <= 4000 and surface.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(surface, axis=1), 1 / 1.03, atol=0.01)


BROKEN = {
    "a.exe": (b"MZ", "not a format"),
    "a.ply": (b"ply\nnothing", "cannot be read as ply"),
    "b.ply": (b"", "empty, larger than 64 MiB"),
    "c.obj": (b"v 0 0 nan\n", "nan"),
    "d.off": (b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", "d.off"),
    "f.xyz": (b"1 2 3\n" * 9, "f.xyz: holds 9 points"),
    "g.npy": (b"\x93NUMPY", "g.npy"),
    "e.gltf": (b'{"asset":{"version":"2.0"},"buffers":[{"uri":"/etc/passwd","byteLength":9}]}', "e.gltf"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_file_is_told_in_one_line(viewer, name):
    content, told_of = BROKEN[name]
    known = list(viewer.shapes)
    viewer.fit(name, content)
    assert told_of in viewer.message.content and "sdfhub-wrong" in viewer.message.content
    assert list(viewer.shapes) == known and "root:" not in viewer.message.content


def test_a_files_name_is_text_on_the_page(viewer):
    viewer.fit("<img src=x onerror=alert(1)>.ply", b"")
    assert "<img" not in viewer.message.content and "&lt;img" in viewer.message.content


def test_without_viser_one_line_says_what_to_install(monkeypatch, run):
    monkeypatch.setitem(sys.modules, "viser", None)
    for name in ("sdfhub.viewer.page", "sdfhub.viewer.loopback"):
        monkeypatch.delitem(sys.modules, name)
    with pytest.raises(SdfhubError, match=r"pip install 'sdfhub\[view\]'"):
        view_task.view(composed(f"run={run}", "port=0", "resolution=32", config_name="view"))


@pytest.mark.parametrize(
    ("key", "value"),
    [("port", 70000), ("port", "x"), ("resolution", 4), ("resolution", 10**6), ("run", "nowhere")],
)
def test_a_wrong_setting_is_one_line(key, value, run):
    config = composed(f"run={run}", "port=0", "resolution=32", f"{key}={value}", config_name="view")
    with pytest.raises(SdfhubError, match=f"{key}=|nowhere"):
        view_task.view(config)
