"""A page of a code's shape: between shapes A and B, moved along principal directions, or fitted to a scan."""

import html
import threading
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sdfhub.errors import SdfhubError
from sdfhub.geometry.surface import sample_surface
from sdfhub.scans import scan as scans
from sdfhub.scans.observed_scan import observe
from sdfhub.shapes import turned_up
from sdfhub.space import Space
from sdfhub.viewer.live_meshing import LiveMesher, Meshed
from sdfhub.viewer.loopback import MAX_UPLOAD, LoopbackServer

# meshes and clouds of a whole shape; archives also carry views and samples, whose frame has to be said
FORMATS = tuple(suffix for suffix in scans.FORMATS if suffix != ".npz")
POINTS = 4000  # points of a scan's surface that are shown
DIRECTIONS, REACH = 6, 3.0  # sliders along principal directions, and how far they go, in standard deviations
RUNGS = (64, 128)  # points along an axis of the grid while something moves, and on the way to rest
FAR = 0.03  # mean distance of a scan's surface to the fitted one, in a size of 2, that no good fit leaves
STRANGE = 2.0  # times as unusual as the most unusual of the space's own codes: no shape of its kind
MEAN = "(mean of all shapes)"
# where the camera stands and looks, z up: a little past the shape, which the controls would cover
EYE_AND_AIM = np.array([[1.75, -2.75, 1.3], [0.25, 0.15, -0.05]])
CLAY, SCAN = (201, 131, 92), (42, 92, 170)
STYLE = (Path(__file__).parent / "viewer.css").read_text(encoding="utf-8")


class Viewer:
    """The page of a space, its grid of `resolution` points along an axis when nothing moves."""

    def __init__(self, space: Space, title: str, port: int, resolution: int):
        self.space, self.scans = space, dict[str, np.ndarray]()
        # codes [L] by the names under which the page offers them
        self.shapes = {id: space.code(id) for id in space.ids} | {MEAN: space.distribution.mean}
        self.axes = space.principal_directions[:DIRECTIONS]
        self.drawn = threading.Event()  # set as soon as there is something to see
        self._reading, self._fitting = threading.Lock(), threading.Lock()
        self.server = LoopbackServer(port, "sdfhub", FORMATS)
        self._add_scene()
        self._add_controls(title)
        rungs = [*(rung for rung in RUNGS if rung < resolution), resolution]
        self.mesher = LiveMesher(space.decoder, rungs, self._draw)
        self.refresh()

    def close(self) -> None:
        """Ends the page and its thread."""
        self.mesher.close()
        self.server.stop()

    def refresh(self) -> None:
        """Asks for the surface of what the controls say."""
        with self._reading:  # viser calls from many threads: what is asked for last was read last
            a, b, share = self.a.value, self.b.value, bounded(self.share.value, 0.0, 1.0)
            steps = torch.tensor([bounded(slider.value, -REACH, REACH) for slider in self.sliders])
            if a in self.shapes and b in self.shapes:
                name = a if share == 0 else f"{a} → {b}, {share:.2f}"
                name += ", moved" * bool(steps.any())
                code = torch.lerp(self.shapes[a], self.shapes[b], share)
                self.mesher.ask(code + steps.to(code) @ self.axes, name)

    def reset(self) -> None:
        """Back to the shape A itself."""
        for slider in (self.share, *self.sliders):
            slider.value = 0.0
        name = self.a.value
        with self.server.atomic():
            self.scan.visible = name in self.scans
            self.scan.points = self.scans.get(name, self.scan.points)
        self.refresh()

    def fit(self, name: str, content: bytes) -> None:
        """Fits a scan, offers it beside the shapes and shows it; says why where that fails."""
        last = PurePath(name.replace("\\", "/")).name or "scan"
        name = "".join(letter for letter in last if letter.isprintable())[-60:]
        try:
            if not content:  # what the gate cut off arrives so
                raise SdfhubError(f"{name}: empty, larger than {MAX_UPLOAD >> 20} MiB or of another type")
            self.message.content = paragraph(f"Fitting {name} …", "small")
            with self._fitting:
                code, surface = fit_scan(self.space, name, content)
                self.message.content = paragraph(f"{name}: {self._quality(code, surface)}", "small")
                self.shapes[name], self.scans[name] = code, surface
                self.a.options = self.b.options = tuple(self.shapes)
                self.a.value = name
                self.reset()
        except SdfhubError as error:
            self.message.content = paragraph(str(error), "wrong")

    def _quality(self, code: Tensor, surface: np.ndarray) -> str:
        """How well a code fits the points of a scan's surface, and whether it is one of this space."""
        with torch.no_grad():
            distance = float(self.space.sdf(surface, code).abs().mean())
        is_strange = self.space.unusual(code) > STRANGE * self.space.unusual(self.space.codes).max()
        doubt = " Doubtful: far, or a code unlike the known ones." if distance > FAR or is_strange else ""
        return f"the scan's surface is {distance:.4f} off the fitted one, on average of a size of 2.{doubt}"

    def _draw(self, meshed: Meshed | SdfhubError) -> None:
        if isinstance(meshed, SdfhubError):
            self.name.content = paragraph(str(meshed), "wrong")
        else:
            vertices, faces = meshed.mesh
            size = f"{len(faces):,} triangles, {meshed.resolution}³, {round(1000 * meshed.seconds)} ms"
            with self.server.atomic():
                self.mesh.visible = bool(len(faces))
                if len(faces):
                    self.mesh.vertices, self.mesh.faces = vertices, faces
                text = paragraph(size if len(faces) else "no surface", "small")
                self.name.content = paragraph(meshed.about, "name") + text
        self.drawn.set()

    def _add_scene(self) -> None:
        scene, up = self.server.scene, self.space.up
        scene.set_up_direction("+z" if up == "z" else "+y")
        camera = self.server.initial_camera
        camera.position, camera.look_at, camera.fov = *turned_up(EYE_AND_AIM, "z", up), 0.66
        below = turned_up(np.array([[0, 0, -1]]), "z", up)[0]
        faint: Any = {"cell_color": (233, 233, 233), "section_color": (222, 222, 222), "fade_distance": 9.0}
        scene.add_grid("/floor", 8, 8, plane="xy" if up == "z" else "xz", position=below, **faint)
        nothing = np.zeros((3, 3))
        self.mesh = scene.add_mesh_simple("/shape", nothing, np.array([[0, 1, 2]]), color=CLAY, side="double")
        dots: Any = {"point_size": 0.008, "point_shape": "circle", "visible": False}
        self.scan = scene.add_point_cloud("/scan", nothing, SCAN, **dots)

    def _add_controls(self, title: str) -> None:
        gui, space, names = self.server.gui, self.space, tuple(self.shapes)
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=CLAY)
        size = f"{len(space.ids)} shapes, codes of {space.codes.shape[1]} numbers"
        gui.add_html(f"<style>{STYLE}</style>" + paragraph(title, "title") + paragraph(size, "small"))
        self.name = gui.add_html(paragraph("…", "name"))
        with gui.add_folder("Shape"):
            self.a: Any = gui.add_dropdown("A", names)
            self.b: Any = gui.add_dropdown("B", names, initial_value=names[1])
            self.share: Any = gui.add_slider("A to B", 0.0, 1.0, 0.01, 0.0)
        with gui.add_folder("Principal directions"):
            hint = "Standard deviations of the codes along this axis; 0 is the shape above"
            axes = range(1, len(self.axes) + 1)
            self.sliders = [gui.add_slider(f"{axis}", -REACH, REACH, 0.05, 0.0, hint=hint) for axis in axes]
            reset = gui.add_button("Back to A", color="gray")
        with gui.add_folder("Fit a scan"):
            upload = gui.add_upload_button("Drop a scan here, or click", mime_type=",".join(FORMATS))
            kinds = f"A mesh or a cloud of a whole shape: {' '.join(FORMATS)}; at most {MAX_UPLOAD >> 20} MiB"
            self.message = gui.add_html(paragraph(kinds, "small"))
        self.a.on_update(lambda _: self.reset())
        for control in (self.b, self.share, *self.sliders):
            control.on_update(lambda _: self.refresh())
        reset.on_click(lambda _: self.reset())
        upload.on_upload(lambda _: self.fit(upload.value.name, upload.value.content))


def fit_scan(space: Space, name: str, content: bytes) -> tuple[Tensor, np.ndarray]:
    """The code [L] of the shape in a file, and points [M, 3] of the scan's surface, normalised frame."""
    rng = np.random.default_rng(0)
    with TemporaryDirectory() as folder:  # a .gltf can name files of its folder: there are none
        path = Path(folder) / f"scan{PurePath(name).suffix}"
        path.write_bytes(content)
        try:
            scan = scans.read_scan(path)
            observed = observe(scan, space.evidence, "shape", rng)
            code = space.fit_observations([observed.observation]).codes[0]
        except (SdfhubError, ValueError) as error:
            reason = str(error).replace(str(path), name)
            raise SdfhubError(reason if name in reason else f"{name}: {reason}") from error
    points, faces = scan.points, scan.faces
    rows = rng.permutation(len(points))[:POINTS]
    surface = points[rows] if faces is None else sample_surface(points, faces, POINTS, rng)[0]
    return code, observed.frame.to_normalized(surface).astype(np.float32)


def bounded(value: float, low: float, high: float) -> float:
    """What a page sent, if it is a number that its slider can have; else 0."""
    return value if low <= value <= high else 0.0


def paragraph(text: str, kind: str) -> str:
    """A paragraph of plain text for the page."""
    return f'<p class="sdfhub-{kind}">{html.escape(text)}</p>'
