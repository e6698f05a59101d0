"""Meshes of the code that was asked for last: a coarse one at once, then finer ones."""

import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError
from queue import SimpleQueue
from typing import Any, NamedTuple

from torch import Tensor

from sdfhub.errors import SdfhubError
from sdfhub.geometry.mesher import Mesh, mesh_fields
from sdfhub.model.decoder import Decoder
from sdfhub.model.fast.computing import distances


class Meshed(NamedTuple):
    """A mesh in the normalised frame of a code that was asked for, empty without a surface, `seconds` ago."""

    about: Any  # what was handed over with the code
    mesh: Mesh
    resolution: int  # points along an axis of its grid
    seconds: float


class LiveMesher:
    """A thread that meshes the latest code on grids of rising `resolutions`: `show` gets each, or an error.

    The first resolution is always finished, so that something moves; a finer one is given up for a new code.
    """

    def __init__(self, decoder: Decoder, resolutions: Sequence[int], show: Callable[[Any], None]):
        self.decoder, self.resolutions, self.show = decoder, tuple(resolutions), show
        self._requests: SimpleQueue[tuple[Tensor, Any, float] | None] = SimpleQueue()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def ask(self, code: Tensor, about: Any = None) -> None:
        """Wants the surface of a code [L]; whatever was asked before is no longer wanted."""
        self._requests.put((code, about, time.perf_counter()))

    def close(self) -> None:
        """Ends the thread."""
        self._requests.put(None)
        self._thread.join()

    def _run(self) -> None:
        while request := self._requests.get():
            if not self._requests.empty():
                continue
            try:
                self._refine(*request)
            except CancelledError:
                pass
            except Exception as error:  # such as no memory left: the page must hear of it, and go on
                self.show(error if isinstance(error, SdfhubError) else SdfhubError(repr(error)))

    def _refine(self, code: Tensor, about: Any, asked: float) -> None:
        for index, resolution in enumerate(self.resolutions):

            def fields(points: Tensor, shapes: Tensor, is_first: bool = index == 0) -> Tensor:
                if not (is_first or self._requests.empty()):
                    raise CancelledError
                return distances(self.decoder, points, code[None].expand(len(shapes), -1))

            mesh = next(mesh_fields(fields, 1, resolution, device=code.device))
            self.show(Meshed(about, mesh, resolution, time.perf_counter() - asked))
