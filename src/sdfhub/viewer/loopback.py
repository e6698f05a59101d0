"""viser's server for one person on one machine: what it answers, to whom, and what it takes from a page.

viser listens to all pages of all browsers that reach it, serves files by path, opens a tunnel to a public
server when a page asks for one, lets a page set any attribute of a control, and takes files of any size.
Here a page comes from this server on a loopback address or is refused, there is one file to read, and of
messages only those pass that the page needs.
"""

import http
import logging
import math
import socket
from collections.abc import Collection
from functools import partial
from typing import Any
from unittest.mock import patch

import msgspec
import viser
import websockets.asyncio.server as sockets
from websockets.http11 import Request, Response

from sdfhub.errors import SdfhubError

HOST = "127.0.0.1"
NAMES = (HOST, "localhost")  # what a browser may call this machine
MAX_UPLOAD = 64 << 20  # bytes of a file; a larger one, or one of another type, arrives as an empty one
PART = 512 << 10  # bytes of the parts in which viser's page sends a file
# what the page may load: itself, and from nowhere but here
POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval' blob: data:; worker-src blob: data:; "
    "style-src 'unsafe-inline'; img-src blob: data:; font-src data:; connect-src ws://{host} blob: data:; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)

_QUIET = logging.getLogger(__name__)
_QUIET.setLevel(logging.CRITICAL)  # whoever knocks and is refused is no news, and none for a traceback


class LoopbackServer(viser.ViserServer):
    """viser behind a gate; files of `suffixes`, in lower case, may be uploaded; port 0 takes a free one."""

    def __init__(self, port: int, label: str, suffixes: Collection[str]):
        try:  # viser would go on to the next port, whoever may wait at this one
            socket.create_server((HOST, port)).close()
        except OSError as error:
            raise SdfhubError(f"port={port}: is taken or not allowed; 0 takes a free one") from error
        with patch.object(sockets, "serve", partial(_Serve, suffixes)):  # viser has no option for it
            super().__init__(host=HOST, port=port, label=label, verbose=False)


def refusal(request: Request) -> tuple[http.HTTPStatus, str] | None:
    """Why a request is not answered; None where it is.

    A page of another site can send requests here, under that site's Origin; under a name that leads to this
    machine only now (DNS rebinding), with that name as Host.
    """
    hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
    if len(hosts) != 1 or hosts[0].partition(":")[0] not in NAMES:
        return http.HTTPStatus.FORBIDDEN, "This page is for its own machine: open it at http://127.0.0.1\n"
    if origins != [f"http://{hosts[0]}"] and ("Upgrade" in request.headers or origins):
        return http.HTTPStatus.FORBIDDEN, "This page is for itself\n"
    if request.path.partition("?")[0] != "/":
        return http.HTTPStatus.NOT_FOUND, "There is one page here: /\n"
    return None


def passed(raw: bytes, suffixes: Collection[str]) -> bytes | None:
    """A page's message as viser shall see it, or None; a file too large or of another type arrives empty."""
    try:
        message: dict[str, Any] = msgspec.msgpack.decode(raw)
        kind = message["type"]
        if kind == "FileTransferStartUpload":
            size, parts = message["size_bytes"], message["part_count"]
            is_known = str(message["filename"]).lower().endswith(tuple(suffixes))
            if is_known and 0 < size <= MAX_UPLOAD and parts == math.ceil(size / PART):
                return raw
            return msgspec.msgpack.encode(message | {"size_bytes": 0, "part_count": 0})
        is_part = kind == "FileTransferPart" and len(message["content"]) <= PART
        is_value = kind == "GuiUpdateMessage" and message["updates"].keys() == {"value"}
        return raw if is_part or is_value or kind == "ViewerCameraMessage" else None
    except (msgspec.DecodeError, LookupError, TypeError, AttributeError, ValueError, OverflowError):
        return None


class _Serve(sockets.serve):
    """websockets' server with a gate before viser's own answers."""

    def __init__(self, suffixes: Collection[str], *arguments: Any, process_request: Any, **options: Any):
        def answer(connection: sockets.ServerConnection, request: Request) -> Response | None:
            refused = refusal(request)
            response = connection.respond(*refused) if refused else process_request(connection, request)
            if response is not None:
                policy = POLICY.format(host=request.headers.get("Host", HOST))
                response.headers["Content-Security-Policy"] = policy
            return response

        class Gated(sockets.ServerConnection):
            """A page's connection, of which viser sees only what passes."""

            async def recv(self, decode: bool | None = None) -> bytes:  # type: ignore[override]
                while True:
                    if (message := passed(await super().recv(decode=False), suffixes)) is not None:
                        return message

        options |= {"create_connection": Gated, "max_size": 2 * PART, "logger": _QUIET}
        super().__init__(*arguments, process_request=answer, **options)
