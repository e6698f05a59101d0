"""What a page shows of shapes: contact sheets, the best and the worst, and meshes to turn."""

import base64
import io
from dataclasses import dataclass, field

import numpy as np
from PIL import Image

from sdfhub.data.workers import stream_in_processes, workers_worth
from sdfhub.report.drawings import Drawing, Subject, drawn
from sdfhub.report.meshes import FindTruth
from sdfhub.report.results import ROLES, ShapeScore
from sdfhub.report.rows import Group, Row

FEWEST, MOST = 400, 4000
"""Triangles of a mesh to turn."""

A_WORKERS_WORTH = 32
"""Meshes for which it pays to start a process that draws them."""


@dataclass(frozen=True)
class Tile:
    """One picture.

    Args:
        drawing: what is seen; None where there is nothing to draw.
        caption: below it.
        alt: what stands in the place of a picture that is not there.
    """

    drawing: Drawing | None
    caption: str
    alt: str

    @property
    def image(self) -> np.ndarray | None:
        """[S, S, 3] uint8; None where there is no surface or no file, and until it is drawn."""
        return self.drawing and self.drawing.image


@dataclass(frozen=True)
class Turning:
    """One shape to turn under the mouse: the truth and each row, by label.

    Args:
        name, role: of the shape.
        drawings: by label.
        triangles: of each, at most.
    """

    name: str
    role: str
    drawings: list[tuple[str, Drawing]]
    triangles: int

    def panels(self) -> list[dict]:
        """The packed meshes of those that have one, for the viewer of the page."""
        packs = [(label, drawing.packs.get(self.triangles)) for label, drawing in self.drawings]
        return [{"label": label} | pack for label, pack in packs if pack]


@dataclass(frozen=True)
class Sheet:
    """Pictures in rows with labels, under columns with captions."""

    columns: list[str]
    rows: list[tuple[str, list[Tile]]]


@dataclass
class Gallery:
    """Says what is to be drawn, and then draws each mesh once.

    Args:
        find_truth: prepared shapes by cell and id.
    """

    find_truth: FindTruth
    _drawings: dict[tuple, Drawing] = field(default_factory=dict)

    def draw(self) -> None:
        """Draws what was asked for since the last time, in as many processes as it is worth."""
        left = [drawing for drawing in self._drawings.values() if not drawing.done]
        workers = workers_worth(len(left), A_WORKERS_WORTH)
        asked = [drawing.asked for drawing in left]
        for drawing, found in zip(left, stream_in_processes(drawn, asked, workers), strict=True):
            drawing.image, drawing.packs = found
            drawing.done = True

    def sheet(self, group: Group, count: int) -> Sheet:
        """Truth, then each row of a group, for some shapes: the paper's figures 2 to 6."""
        shown = chosen(group, count)
        columns = [f"{id} ({'known' if role == 'known' else 'held out'})" for role, id in shown]
        first = _first_done(group)
        truth = [self._truth_tile(first, id, "") for _, id in shown]
        rows = [("Ground truth", truth)] if any(tile.drawing for tile in truth) else []
        for row in group.rows:
            absent = Tile(
                None, "", "failed" if any(cell.state == "failed" for cell in row.cells) else "missing"
            )
            tiles = [self._tile(row, role, id) if row.done else absent for role, id in shown]
            rows.append((row.label, tiles))
        return Sheet(columns, rows)

    def extremes(self, group: Group) -> Sheet:
        """Best, median and worst known shape of each row, the truth beside each."""
        names = ("best", "median", "worst")
        columns = [text for name in names for text in (f"{name}: truth", name)]
        rows = []
        for row in group.rows:
            shapes = row.done[0].scores.shapes.get("known", []) if row.done else []
            if shapes:
                ranked = sorted(shapes, key=lambda shape: shape.excess)
                picked = (ranked[0], ranked[(len(ranked) - 1) // 2], ranked[-1])
                tiles = [tile for shape in picked for tile in self._pair(row, shape)]
                rows.append((row.label, tiles))
        return Sheet(columns, rows)

    def turning(self, group: Group, count: int, budget: int) -> list[Turning]:
        """Some shapes, truth and rows, decimated for the viewer of the page.

        Args:
            group: whose.
            count: shapes at most.
            budget: bytes for all of them.
        """
        shown = chosen(group, count)
        rows = [row for row in group.rows if row.done]
        triangles = budget // max(1, len(shown) * (len(rows) + 1) * 12)  # some 12 bytes each, as base64
        triangles = min(MOST, max(FEWEST, triangles))
        found = []
        for role, id in shown:
            drawings = [("Ground truth", self._truth(rows[0], id))]
            for row in rows:
                score = _score(row, role, id)
                drawings.append((row.label, score and self._reconstruction(row, role, score)))
            there = [(label, drawing.packed(triangles)) for label, drawing in drawings if drawing]
            found.append(Turning(id, role.replace("_", " "), there, triangles))
        return found

    def _pair(self, row: Row, shape: ShapeScore) -> list[Tile]:
        return [self._truth_tile(row, shape.id, shape.id), self._tile(row, "known", shape.id)]

    def _tile(self, row: Row, role: str, id: str) -> Tile:
        score = _score(row, role, id)
        if score is None:
            return Tile(None, "", "not judged")
        caption = "no surface" if score.failed else f"CD {score.counted_cd * 1e3:.3f}"
        alt = "no surface" if score.failed else "no mesh"
        return Tile(self._reconstruction(row, role, score).pictured(), caption, alt)

    def _reconstruction(self, row: Row, role: str, score: ShapeScore) -> Drawing:
        folder = row.done[0].folder
        key = (folder, role, score.id)
        if key not in self._drawings:
            truth = self.find_truth(row.done[0], score.id)
            self._drawings[key] = Drawing(Subject(truth, folder, role, score))
        return self._drawings[key]

    def _truth(self, row: Row, id: str) -> Drawing | None:
        truth = self.find_truth(row.done[0], id)
        if truth is None or not truth.rows("faces"):
            return None
        return self._drawings.setdefault(("truth", truth.path), Drawing(Subject(truth)))

    def _truth_tile(self, row: Row, id: str, caption: str) -> Tile:
        truth = self._truth(row, id)
        return Tile(truth and truth.pictured(), caption, "no truth")


def _score(row: Row, role: str, id: str) -> ShapeScore | None:
    """The score in the row's first finished seed."""
    return next((score for score in row.done[0].scores.shapes.get(role, []) if score.id == id), None)


def _first_done(group: Group) -> Row | None:
    return next((row for row in group.rows if row.done), None)


def chosen(group: Group, count: int) -> list[tuple[str, str]]:
    """Role and id of the shapes to show: known ones, and up to a third held out, from the front of each."""
    row = _first_done(group)
    if row is None:
        return []
    known, unseen = ([shape.id for shape in row.done[0].scores.shapes.get(role, [])] for role in ROLES)
    unseen = unseen[: max(count // 3, count - len(known))]
    known = known[: count - len(unseen)]
    return [("known", id) for id in known] + [("held_out", id) for id in unseen]


def data_uri(image: np.ndarray) -> str:
    """A picture as a WebP data URI."""
    content = io.BytesIO()
    Image.fromarray(image).save(content, "WEBP", quality=82)
    return "data:image/webp;base64," + base64.b64encode(content.getvalue()).decode()
