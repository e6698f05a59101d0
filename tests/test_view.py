"""The viewer's page: what it shows, what it takes, whom it answers. Without a browser; see test_view_page."""

import http.client
import socket
import sys
import threading
import time

import msgspec
import numpy as np
import pytest
import torch
import trimesh
import viser
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.http11 import Request
from websockets.sync.client import connect

import sdfhub
from sdfhub.errors import SdfhubError
from sdfhub.space import reconstruct
from sdfhub.tasks import view as view_task
from sdfhub.tasks.dropped_scan import fit_scan
from sdfhub.tasks.live_meshing import LiveMesher, Meshed
from sdfhub.tasks.loopback import MAX_UPLOAD, PART, Gate, refusal
from sdfhub.tasks.viewer import MEAN, Viewer, told
from tests.ball_space import IDS, RADII, write_ball_run


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


def size_shown(viewer) -> float:
    return float(np.linalg.norm(viewer.mesh.vertices, axis=1).mean())


def shows(viewer, name: str):
    wait_until(lambda: told(name, "name") in viewer.name.content)


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
    assert viewer.scan.visible and viewer.overlay.visible
    np.testing.assert_allclose(np.linalg.norm(viewer.scan.points, axis=1), 1 / 1.03, atol=0.01)
    assert "off the fitted one" in viewer.message.content
    viewer.a.value = IDS[0]
    shows(viewer, IDS[0])
    wait_until(lambda: not viewer.scan.visible)


def test_a_fit_is_that_of_the_meshs_own_signed_distances(space):
    code, surface = fit_scan(space, "ball.obj", ball_file(kind="obj"))
    assert surface.shape == (4000, 3)
    largest = space.sdf(surface, IDS[3]).abs().mean()  # the normalised ball is larger than all of the space
    assert space.sdf(surface, code).abs().mean() < largest


BROKEN = {
    "a.exe": (b"MZ", "not a mesh format"),
    "a.ply": (b"ply\nnothing", "cannot be read as ply"),
    "b.ply": (b"", "empty, larger than 64 MiB"),
    "c.obj": (b"v 0 0 nan\n", "nan"),
    "d.off": (b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", "d.off"),
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


def request(path="/", **headers) -> Request:
    return Request(path, Headers([(name.replace("_", "-"), value) for name, value in headers.items()]))


HERE = {"Host": "127.0.0.1:8080"}
SOCKET = HERE | {"Upgrade": "websocket"}


@pytest.mark.parametrize("wanted", [
    request(**HERE),
    request("/?a=b", Host="localhost:8080"),
    request(Origin="http://localhost:9", Upgrade="websocket", Host="localhost:9"),
])  # fmt: skip
def test_its_own_page_is_answered(wanted):
    assert refusal(wanted) is None


@pytest.mark.parametrize("wanted", [
    request(Host="evil.example:8080"),
    request(Host="127.0.0.1.evil.example"),
    request(Host="192.168.0.2:8080"),
    request(),
    request(**SOCKET),
    request(**SOCKET, Origin="http://evil.example"),
    request(**SOCKET, Origin="http://localhost:8080"),
    request(**SOCKET, Origin="http://127.0.0.1:8081"),
    request(**SOCKET, Origin="null"),
    request(**HERE, Origin="https://evil.example"),
    request("/index.html", **HERE),
    request("/../../../../etc/passwd", **HERE),
    request("/%2e%2e/%2e%2e/etc/passwd", **HERE),
    request("//etc/passwd", **HERE),
    request("/viser.py", **HERE),
])  # fmt: skip
def test_everyone_else_and_every_other_path_is_refused(wanted):
    status, _ = refusal(wanted)
    assert status in (403, 404)


def packed(**message) -> bytes:
    return msgspec.msgpack.encode(message)


def start(name="a.ply", size=PART + 1, parts=2, uuid="u", **more) -> bytes:
    message = {"source_component_uuid": "c", "transfer_uuid": uuid, "filename": name, "mime_type": ""}
    return packed(type="FileTransferStartUpload", **message, size_bytes=size, part_count=parts, **more)


def part(index, uuid="u", content=b"x") -> bytes:
    message = {"source_component_uuid": "c", "transfer_uuid": uuid, "part_index": index, "content": content}
    return packed(type="FileTransferPart", **message)


def announced(raw: bytes) -> int:
    return msgspec.msgpack.decode(raw)["part_count"]


@pytest.mark.parametrize("raw", [
    packed(type="ShareUrlRequest"),
    packed(type="GuiUpdateMessage", uuid="a", updates={"update_cb": []}),
    packed(type="GuiUpdateMessage", uuid="a", updates={"value": 1, "gui_api": None}),
    packed(type="GuiUpdateMessage", uuid="a", updates=[]),
    packed(type="RunJavascriptMessage", source="alert(1)"),
    packed(type="FileTransferStartDownload", filename="/etc/passwd"),
    packed(type=["GuiUpdateMessage"]),
    packed(kind="x"),
    b"\xc1 no message",
    b"",
])  # fmt: skip
def test_messages_that_the_page_does_not_need_do_not_pass(raw):
    assert Gate((".ply",)).passed(raw) is None


def test_values_and_the_camera_pass_as_they_are():
    for raw in (
        packed(type="GuiUpdateMessage", uuid="a", updates={"value": 0.5}),
        packed(type="ViewerCameraMessage"),
    ):
        assert Gate(()).passed(raw) == raw


@pytest.mark.parametrize("wrong", [
    start(size=MAX_UPLOAD + 1, parts=MAX_UPLOAD // PART + 1),
    start("a.exe"),
    start("a.ply/../b"),
    start(parts=3),
    start(size=-1, parts=0),
    start(size=0, parts=10**9),
])  # fmt: skip
def test_an_upload_that_is_too_large_or_of_another_type_arrives_empty(wrong):
    gate = Gate((".ply",))
    assert announced(gate.passed(wrong)) == 0
    assert gate.passed(part(0)) is None


def test_an_upload_takes_its_own_parts_once_and_one_goes_on_at_a_time():
    gate = Gate((".ply",))
    assert announced(gate.passed(start("A.PLY"))) == 2
    assert gate.passed(part(0, content=b"x" * (PART + 1))) is None
    assert gate.passed(part(0)) and gate.passed(part(0)) is None
    assert gate.passed(part(2)) is None and gate.passed(part(1, uuid="other")) is None
    assert announced(gate.passed(start(uuid="second"))) == 0
    assert gate.passed(part(1))
    assert announced(gate.passed(start(uuid="third"))) == 2


def get(viewer, path, host=None):
    port = viewer.server.get_port()
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    connection.putrequest("GET", path, skip_host=True)
    connection.putheader("Host", host or f"127.0.0.1:{port}")
    connection.endheaders()
    response = connection.getresponse()
    return response.status, response.read(), dict(response.getheaders())


def test_the_server_gives_one_page_which_may_load_nothing_from_elsewhere(viewer):
    status, content, headers = get(viewer, "/")
    assert status == 200 and b"<html" in content
    assert headers["Content-Security-Policy"].startswith("default-src 'none'")
    assert "http:" not in headers["Content-Security-Policy"]
    for path in (
        "/../../../_viser.py",
        "/%2e%2e/%2e%2e/package.json",
        "//etc/passwd",
        "/..%5c..%5cpackage.json",
    ):
        assert get(viewer, path)[:2] == (404, b"There is one page here: /\n")
    assert get(viewer, "/", host="evil.example")[0] == 403


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux has more than one loopback address")
def test_the_server_listens_on_its_loopback_address_alone(viewer):
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.2", viewer.server.get_port()), timeout=5)


def open_socket(viewer, origin):
    protocol = f"viser-v{viser.__version__}"
    return connect(f"ws://127.0.0.1:{viewer.server.get_port()}", origin=origin, subprotocols=[protocol])


def test_a_page_of_another_site_gets_no_connection(viewer):
    for origin in (None, "http://evil.example", "null"):
        with pytest.raises(InvalidStatus):
            open_socket(viewer, origin)


def test_a_hostile_page_reads_nothing_opens_no_tunnel_and_breaks_nothing(viewer, monkeypatch):
    tunnels = []
    monkeypatch.setattr(viser.ViserServer, "request_share_url", lambda *_, **__: tunnels.append(1))
    viewer.a.value = IDS[0]
    with open_socket(viewer, f"http://127.0.0.1:{viewer.server.get_port()}") as page:
        assert page.recv(timeout=10)
        uuid = viewer.a._impl.uuid
        page.send(packed(type="ShareUrlRequest"))
        page.send(packed(type="GuiUpdateMessage", uuid=uuid, updates={"update_cb": []}))
        page.send(packed(type="GuiUpdateMessage", uuid=uuid, updates={"value": "../../etc/passwd"}))
        page.send(b"\xff" * 100)
        wait_until(lambda: viewer.a.value == "../../etc/passwd")
        page.send(b"x" * (2 * PART + 1))
        with pytest.raises(ConnectionClosed):
            while True:
                page.recv(timeout=10)
    viewer.a.value = IDS[2]
    shows(viewer, IDS[2])
    assert not tunnels and viewer.a._impl.update_cb


def test_a_port_that_is_taken_is_one_line(viewer, space):
    port = viewer.server.get_port()
    with pytest.raises(SdfhubError, match=f"port={port}: is taken"):
        Viewer(space, "balls", port, 32)


def test_without_viser_one_line_says_what_to_install(monkeypatch, run):
    monkeypatch.setitem(sys.modules, "viser", None)
    for name in ("sdfhub.tasks.viewer", "sdfhub.tasks.loopback"):
        monkeypatch.delitem(sys.modules, name)
    with pytest.raises(SdfhubError, match=r"pip install 'sdfhub\[view\]'"):
        view_task.view({"run": str(run), "port": 0, "resolution": 32})


@pytest.mark.parametrize(
    ("key", "value"),
    [("port", 70000), ("port", "x"), ("resolution", 4), ("resolution", 10**6), ("run", "nowhere")],
)
def test_a_wrong_setting_is_one_line(key, value, run):
    with pytest.raises(SdfhubError, match=f"{key}=|nowhere"):
        view_task.view({"run": str(run), "port": 0, "resolution": 32, key: value})
