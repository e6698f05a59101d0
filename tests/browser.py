"""A page in a headless browser, for tests that look at one."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager

import pytest


def browser() -> str | None:
    names = [os.environ.get("SDFHUB_BROWSER", ""), "chromium", "chromium-browser", "google-chrome"]
    return next((found for name in names if name and (found := shutil.which(name))), None)


@contextmanager
def empty_page(width: int, height: int) -> Iterator:
    """A page without content that keeps what is `said` to its console, as (type, text), and `asked` for."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    executable = browser()
    if executable is None:
        pytest.skip("no Chromium on PATH or in SDFHUB_BROWSER to look at the page with")
    flags = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    flags += ["--no-sandbox"] if os.name == "posix" and os.geteuid() == 0 else []
    with playwright.sync_playwright() as driver:
        chromium = driver.chromium.launch(executable_path=executable, args=flags)
        page = chromium.new_page(viewport={"width": width, "height": height})
        page.said, page.asked = [], []
        page.on("console", lambda message: page.said.append((message.type, message.text)))
        page.on("pageerror", lambda error: page.said.append(("error", str(error))))
        page.on("request", lambda request: page.asked.append(request.url))
        page.on("websocket", lambda socket: page.asked.append(socket.url))
        yield page
        chromium.close()
