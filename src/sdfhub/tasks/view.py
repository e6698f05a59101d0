"""Task `view`: a page on this machine on which a space's shapes can be turned, moved, mixed and fitted."""

import threading
from pathlib import Path

from omegaconf import DictConfig

from sdfhub.errors import SdfhubError
from sdfhub.opening import load
from sdfhub.tasks.app import run_task


def view(config: DictConfig) -> None:
    """The task: `config` as conf/view.yaml has it. Returns when the process is interrupted."""
    if not 0 <= config.port <= 65535 or not 8 <= config.resolution <= 512:
        raise SdfhubError(f"port={config.port}, resolution={config.resolution}: 0 to 65535, and 8 to 512")
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


def main() -> None:
    """Console entry: `sdfhub view RUN`."""
    run_task(view, "view", ["run"])
