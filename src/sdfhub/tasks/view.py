"""Task `view`: a page on this machine on which a space's shapes can be turned, moved, mixed and fitted."""

import threading
from pathlib import Path
from typing import Annotated, Any

from omegaconf import DictConfig
from pydantic import Field

from sdfhub.errors import SdfhubError
from sdfhub.tasks.app import run_task
from sdfhub.composition import plain
from sdfhub.described import check
from sdfhub.opening import load
from sdfhub.tasks.words import take_words


def view(config: dict[str, Any]) -> None:
    """The task: `config` as conf/view.yaml has it. Returns when the process is interrupted."""
    run = check(config["run"], str, "run")
    port = check(config["port"], Annotated[int, Field(ge=0, le=65535)], "port")
    resolution = check(config["resolution"], Annotated[int, Field(ge=8, le=512)], "resolution")
    try:
        from sdfhub.viewer.page import Viewer
    except ImportError as error:
        raise SdfhubError("view: needs more packages: pip install 'sdfhub[view]'") from error
    viewer = Viewer(load(run), Path(run).resolve().name, port, resolution)
    try:
        viewer.drawn.wait()  # the first mesh waits for compilers
        print(f"http://127.0.0.1:{viewer.server.get_port()} shows {run}; Ctrl-C ends it", flush=True)
        threading.Event().wait()
    finally:
        viewer.close()


def main() -> None:
    """Console entry: `sdfhub view RUN`."""
    take_words("run")

    def task(config: DictConfig) -> None:
        view(plain(config))

    run_task(task, "view")
