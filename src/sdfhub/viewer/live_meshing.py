"""Meshes of the code that was asked for last: a coarse one at once, then finer ones."""

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from queue import SimpleQueue
from typing import Any

from torch import Tensor

from sdfhub.errors import SdfhubError
from sdfhub.geometry.mesher import Mesh, mesh_fields
from sdfhub.model.decoder import Decoder
from sdfhub.model.fast.computing import distances


@dataclass(frozen=True, eq=False)
class Meshed:
    """A mesh in the normalised frame of a code that was asked for, empty without a surface, `seconds` ago."""

    about: Any  # what was handed over with the code
    mesh: Mesh
    resolution: int  # points along an axis of its grid
    seconds: float


class LiveMesher:
    """A thread that meshes the latest code on grids of rising `resolutions` and calls `show` with each mesh.

    The first resolution is always finished, so that something moves while codes come faster than meshes; a
    finer one is given up as soon as another code is asked for. `show` also gets the reason of a failure.
    """

    def __init__(
        self, decoder: Decoder, resolutions: Sequence[int], show: Callable[[Meshed | SdfhubError], None]
    ):
        self.decoder, self.resolutions, self.show = decoder, tuple(resolutions), show
        self._requests: SimpleQueue[tuple[Tensor, Any, float] | None] = SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="mesher", daemon=True)
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
            except _Outdated:
                pass
            except Exception as error:  # such as no memory left: the page must hear of it, and go on
                reason = f"{type(error).__name__}: {error}"
                self.show(error if isinstance(error, SdfhubError) else SdfhubError(reason))

    def _refine(self, code: Tensor, about: Any, asked: float) -> None:
        for index, resolution in enumerate(self.resolutions):

            def fields(points: Tensor, shapes: Tensor, is_first: bool = index == 0) -> Tensor:
                if not (is_first or self._requests.empty()):
                    raise _Outdated
                return distances(self.decoder, points, code[None].expand(len(shapes), -1))

            mesh = next(mesh_fields(fields, 1, resolution, device=code.device))
            self.show(Meshed(about, mesh, resolution, time.perf_counter() - asked))


class _Outdated(Exception):
    """Another code was asked for."""
