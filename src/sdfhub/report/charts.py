"""Charts of a report as SVG: the loss while training, and the Chamfer distance of each shape."""

import base64
import io
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sdfhub.report.rows import Group, Row

STYLE = {"svg.fonttype": "none", "svg.hashsalt": "sdfhub", "font.family": "sans-serif", "font.size": 9}
STYLE |= {"axes.grid": True, "grid.color": "#e2e4e8", "axes.spines.top": False, "axes.spines.right": False}

KEEP = {"scalars": 0, "images": 1, "audio": 1, "histograms": 1, "tensors": 1}
"""Of each tag in an event file; 0 keeps all."""


@matplotlib.rc_context(STYLE)
def loss_chart(group: Group) -> str | None:
    """Loss of signed distances by step, a line a seed, as a data URI; None where no run has kept it."""
    figure = Figure((7.6, 4.2), layout="constrained")
    axes = figure.subplots()
    for row in group.rows:
        for number, curve in enumerate(filter(None, (loss_curve(cell.folder) for cell in row.done))):
            label = _text(row.label) if number == 0 else None
            line = "-" if row.normals == "on" else "--"
            axes.plot(*zip(*curve, strict=True), color=_colour(group, row), ls=line, lw=1.3, label=label)
    if not axes.lines:
        return None
    axes.set(xlabel="step", ylabel="clamped L1", yscale="log")
    axes.legend(frameon=False, fontsize=8)
    return _data_uri(figure)


@matplotlib.rc_context(STYLE)
def shape_chart(group: Group, role: str) -> str | None:
    """CD of each shape of a role, a line of dots a row, all seeds, as a data URI; None without any.

    A bar stands at each row's median, a dotted line at the noise floor; the worst shape is named.
    """
    shapes = group.shapes[(group.shapes["role"] == role) & (group.shapes["cd"] > 0)]
    rows = [row for row in group.rows if (shapes["label"] == row.label).any()]
    if not rows:
        return None
    figure = Figure((7.6, 0.8 + 0.3 * len(rows)), layout="constrained")
    axes = figure.subplots()
    for height, row in enumerate(rows):
        line, colour = shapes[shapes["label"] == row.label], _colour(group, row)
        cds = line["cd"].to_numpy()
        spread = height + 0.035 * (np.arange(len(cds)) * 5 % 9 - 4)  # the same at every drawing
        face = colour if row.normals == "on" else "none"
        axes.scatter(cds, spread, s=14, color=face, edgecolors=colour, alpha=0.7)
        axes.vlines(np.median(cds), height - 0.35, height + 0.35, color=colour, lw=2.5)
        worst = cds.argmax()
        place = {"xytext": (5, 0), "textcoords": "offset points", "fontsize": 7, "va": "center"}
        axes.annotate(_text(line["shape"].iloc[worst]), (cds[worst], spread[worst]), **place)
    axes.axvline(shapes["floor"].mean(), color="#5d6672", ls=":", lw=1)
    axes.set(xscale="log", xlabel="CD times 10³ (dotted: noise floor)", ylim=(len(rows) - 0.5, -0.5))
    axes.set_yticks(range(len(rows)), [_text(row.label) for row in rows])
    return _data_uri(figure)


def loss_curve(run: Path, tag: str = "loss/sdf", points: int = 240) -> list[tuple[int, float]]:
    """A logged value by step where above 0, thinned out to so many points; [] where it cannot be read."""
    folder = run / "tensorboard"
    if not folder.resolve().is_relative_to(run.resolve()):
        return []
    try:
        scalars = EventAccumulator(str(folder), size_guidance=KEEP).Reload().Scalars(tag)
    except Exception:  # no such folder or tag, or a file that a kill cut off: a picture less, no error
        return []
    curve = sorted({event.step: event.value for event in scalars if 0 < event.value < 1e12}.items())
    return curve[::-1][:: max(1, -(-len(curve) // points))][::-1]


def _colour(group: Group, row: Row) -> str:
    """A colour for each method."""
    methods = list(dict.fromkeys(rival.method for rival in group.rows))
    return f"C{methods.index(row.method) % 10}"


def _text(text: str) -> str:
    """A label of bearable length in which matplotlib finds no formulas."""
    return (text if len(text) < 60 else f"{text[:58]}…").replace("$", r"\$")


def _data_uri(figure: Figure) -> str:
    content = io.BytesIO()
    figure.savefig(content, format="svg", metadata={"Date": None})
    return "data:image/svg+xml;base64," + base64.b64encode(content.getvalue()).decode()
