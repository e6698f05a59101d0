"""Task `view`: a page on this machine on which a space's shapes can be turned, moved, mixed and fitted."""

import threading
from pathlib import Path
from typing import Annotated

from omegaconf import DictConfig
from pydantic import Field

from sdfhub.described import check
from sdfhub.errors import SdfhubError
from sdfhub.opening import load


def view(config: DictConfig) -> None:
    """The task: `config` as conf/view.yaml has it. Returns when the process is interrupted."""
    check(config.port, Annotated[int, Field(ge=0, le=65535)], "port")
    check(config.resolution, Annotated[int, Field(ge=8, le=512)], "resolution")
    try:
        from sdfhub.viewer.page import Viewer
    except ImportError as error:
        raise SdfhubError("view: needs more packages: pip install 'sdfhub[view]'") from error
    space = load(config.run, trust=config.trust or ())
    viewer = Viewer(space, Path(config.run).resolve().name, config.port, config.resolution)
    try:
        viewer.drawn.wait()  # the first mesh waits for compilers
        print(f"http://127.0.0.1:{viewer.server.get_port()} shows {config.run}; Ctrl-C ends it", flush=True)
        threading.Event().wait()
    finally:
        viewer.close()
