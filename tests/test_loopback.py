"""viser behind its gate: who is answered, what can be read, and which messages pass."""

import http.client
import socket
import sys

import msgspec
import pytest
import viser
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.http11 import Request
from websockets.sync.client import connect

from sdfhub.errors import SdfhubError
from sdfhub.viewer.loopback import MAX_UPLOAD, PART, LoopbackServer, passed, refusal
from tests.test_view import wait_until


@pytest.fixture(scope="module")
def server():
    server = LoopbackServer(0, "a page", (".ply",))
    yield server
    server.stop()


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


def start(name="a.ply", size=PART + 1, parts=2, uuid="u", source="c") -> bytes:
    message = {"source_component_uuid": source, "transfer_uuid": uuid, "filename": name, "mime_type": ""}
    return packed(type="FileTransferStartUpload", **message, size_bytes=size, part_count=parts)


def part(index, uuid="u", content=b"x", source="c") -> bytes:
    message = {
        "source_component_uuid": source,
        "transfer_uuid": uuid,
        "part_index": index,
        "content": content,
    }
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
    assert passed(raw, (".ply",)) is None


def test_values_and_the_camera_pass_as_they_are():
    for raw in (
        packed(type="GuiUpdateMessage", uuid="a", updates={"value": 0.5}),
        packed(type="ViewerCameraMessage"),
    ):
        assert passed(raw, ()) == raw


@pytest.mark.parametrize("wrong", [
    start(size=MAX_UPLOAD + 1, parts=MAX_UPLOAD // PART + 1),
    start("a.exe"),
    start("a.ply/../b"),
    start(parts=3),
    start(size=-1, parts=0),
    start(size=0, parts=10**9),
])  # fmt: skip
def test_an_upload_that_is_too_large_or_of_another_type_arrives_empty(wrong):
    assert announced(passed(wrong, (".ply",))) == 0


def test_an_upload_passes_in_parts_of_bounded_size():
    assert announced(passed(start("A.PLY"), (".ply",))) == 2
    assert passed(part(0), ()) and passed(part(0, content=b"x" * (PART + 1)), ()) is None


def get(server, path, host=None):
    port = server.get_port()
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    connection.putrequest("GET", path, skip_host=True)
    connection.putheader("Host", host or f"127.0.0.1:{port}")
    connection.endheaders()
    response = connection.getresponse()
    return response.status, response.read(), dict(response.getheaders())


def test_the_server_gives_one_page_which_may_load_nothing_from_elsewhere(server):
    status, content, headers = get(server, "/")
    assert status == 200 and b"<html" in content
    assert headers["Content-Security-Policy"].startswith("default-src 'none'")
    assert "http:" not in headers["Content-Security-Policy"]
    for path in (
        "/../../../_viser.py",
        "/%2e%2e/%2e%2e/package.json",
        "//etc/passwd",
        "/..%5c..%5cpackage.json",
    ):
        assert get(server, path)[:2] == (404, b"There is one page here: /\n")
    assert get(server, "/", host="evil.example")[0] == 403


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux has more than one loopback address")
def test_the_server_listens_on_its_loopback_address_alone(server):
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.2", server.get_port()), timeout=5)


def open_socket(server, origin):
    protocol = f"viser-v{viser.__version__}"
    return connect(f"ws://127.0.0.1:{server.get_port()}", origin=origin, subprotocols=[protocol])


def test_a_page_of_another_site_gets_no_connection(server):
    for origin in (None, "http://evil.example", "null"):
        with pytest.raises(InvalidStatus):
            open_socket(server, origin)


def test_a_hostile_page_opens_no_tunnel_and_sets_nothing_but_values(server, monkeypatch):
    choice = server.gui.add_dropdown("shape", ("a", "b"))
    tunnels = []
    monkeypatch.setattr(viser.ViserServer, "request_share_url", lambda *_, **__: tunnels.append(1))
    with open_socket(server, f"http://127.0.0.1:{server.get_port()}") as page:
        assert page.recv(timeout=10)
        uuid = choice._impl.uuid
        page.send(packed(type="ShareUrlRequest"))
        page.send(packed(type="GuiUpdateMessage", uuid=uuid, updates={"update_cb": ["x"]}))
        page.send(packed(type="GuiUpdateMessage", uuid=uuid, updates={"value": "../../etc/passwd"}))
        page.send(b"\xff" * 100)
        wait_until(lambda: choice.value == "../../etc/passwd")
        page.send(b"x" * (2 * PART + 1))
        with pytest.raises(ConnectionClosed):
            while True:
                page.recv(timeout=10)
    assert not tunnels and choice._impl.update_cb == []
    choice.remove()


def test_a_port_that_is_taken_is_one_line(server):
    port = server.get_port()
    with pytest.raises(SdfhubError, match=f"port={port}: is taken"):
        LoopbackServer(port, "another", ())


def test_an_uploaded_file_arrives_whole_and_a_refused_one_empty(server):
    arrived = []
    button = server.gui.add_upload_button("drop")
    button.on_upload(lambda _: arrived.append((button.value.name, button.value.content)))
    with open_socket(server, f"http://127.0.0.1:{server.get_port()}") as page:
        camera = {
            "wxyz": (1, 0, 0, 0),
            "position": (0, 0, 1),
            "look_at": (0, 0, 0),
            "up_direction": (0, 1, 0),
        }
        window = {"image_height": 9, "image_width": 9, "fov": 1.0, "near": 0.1, "far": 9.0}
        page.send(packed(type="ViewerCameraMessage", **camera, **window))
        wait_until(server.get_clients)
        for name, content in (("../../a.ply", b"x" * PART + b"y"), ("b.exe", b"x")):
            sizes = {"size": len(content), "parts": -(-len(content) // PART), "uuid": name}
            page.send(start(name, source=button._impl.uuid, **sizes))
            for index in range(sizes["parts"]):
                page.send(part(index, name, content[index * PART :][:PART], button._impl.uuid))
            wait_until(lambda name=name: arrived and arrived[-1][0] == name)
    assert arrived == [("../../a.ply", b"x" * PART + b"y"), ("b.exe", b"")]
    button.remove()
