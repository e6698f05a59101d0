"""Charts of a report as SVG: the loss while training, and the Chamfer distance of each shape."""

import base64
import io
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sdfhub.report.results import ROLES
from sdfhub.report.rows import Group
from sdfhub.report.tables import TITLES

STYLE: dict[Any, Any] = {"svg.fonttype": "none", "svg.hashsalt": "sdfhub", "font.size": 9}
STYLE |= {"axes.grid": True, "grid.color": "#e2e4e8", "axes.spines.top": False, "axes.spines.right": False}


def charts(group: Group) -> list[tuple[str, str]]:
    """Caption and SVG, as a data URI, of each chart that there is something to draw in."""
    pictures = {"Loss of signed distances while training, a line a seed": loss_chart(group)}
    for role in ROLES:
        pictures[f"{TITLES[role]}: CD of each, all seeds; the bar is the median"] = shape_chart(group, role)
    return [(caption, chart) for caption, chart in pictures.items() if chart]


@matplotlib.rc_context(STYLE)
def loss_chart(group: Group) -> str | None:
    """Loss of signed distances by step, a line a seed, as a data URI; None where no run has kept it."""
    figure = Figure((7.6, 4.2), layout="constrained")
    axes = figure.subplots()
    for index, row in enumerate(group.rows):
        curves = filter(None, (loss_curve(cell.folder) for cell in row.done))
        for number, curve in enumerate(curves):
            label, line = None if number else _text(row.label), "-" if row.normals == "on" else "--"
            axes.plot(*zip(*curve, strict=True), color=f"C{index % 10}", ls=line, lw=1.3, label=label)
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
    labels = list(dict.fromkeys(shapes["label"]))
    if not labels:
        return None
    figure = Figure((7.6, 0.8 + 0.3 * len(labels)), layout="constrained")
    axes = figure.subplots()
    for height, label in enumerate(labels):
        line, colour = shapes[shapes["label"] == label], f"C{height % 10}"
        worst = line.loc[line["cd"].idxmax()]
        axes.scatter(line["cd"], np.full(len(line), height), s=14, color=colour, alpha=0.5)
        axes.vlines(line["cd"].median(), height - 0.35, height + 0.35, color=colour, lw=2.5)
        axes.annotate(_text(worst["shape"]), (worst["cd"], height - 0.15), fontsize=7)
    axes.axvline(shapes["floor"].mean(), color="#5d6672", ls=":", lw=1)
    axes.set(xscale="log", xlabel="CD times 10³ (dotted: noise floor)", ylim=(len(labels) - 0.5, -0.5))
    axes.set_yticks(range(len(labels)), list(map(_text, labels)))
    return _data_uri(figure)


def loss_curve(run: Path, tag: str = "loss/sdf", points: int = 240) -> list[tuple[int, float]]:
    """A logged value by step where above 0, thinned out to so many points; [] where it cannot be read."""
    folder = run / "tensorboard"
    if not folder.resolve().is_relative_to(run.resolve()):
        return []
    try:
        keep = {"scalars": 0, "images": 1, "tensors": 1}  # of each tag; 0 is all
        scalars = EventAccumulator(str(folder), size_guidance=keep).Reload().Scalars(tag)
    except Exception:  # no such folder or tag, or a file that a kill cut off: a picture less, no error
        return []
    curve = sorted({event.step: event.value for event in scalars if 0 < event.value < 1e12}.items())
    return curve[:: max(1, -(-len(curve) // points))]


def _text(text: str) -> str:
    """A label of bearable length in which matplotlib finds no formulas."""
    return (text if len(text) < 60 else f"{text[:58]}…").replace("$", r"\$")


def _data_uri(figure: Figure) -> str:
    content = io.BytesIO()
    figure.savefig(content, format="svg", metadata={"Date": None})
    return "data:image/svg+xml;base64," + base64.b64encode(content.getvalue()).decode()
