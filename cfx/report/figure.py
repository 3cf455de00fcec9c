"""What the plots of a report share: the figure that a page draws when it comes into view, axes and colours.

Every text from data is escaped: Plotly reads tags such as `<a href=...>` in names and labels.
"""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cfx.figures.look import INK, LABELS, PALE, percent
from cfx.report.read import finite

Array = NDArray[np.float64]
Trace = dict[str, Any]


JOB_COLOURS = (
    "#332288",
    "#cc6677",
    "#117733",
    "#ddaa33",
    "#88ccee",
    "#882255",
    "#44aa99",
    "#999933",
    "#777777",
)
"""Tol's muted colours, told apart by readers with any colour vision, none a method's."""

_SYMBOLS = ("circle", "square", "diamond", "cross", "x", "star", "hexagon", "pentagon")
_FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, sans-serif"


@dataclass(frozen=True)
class Plot:
    """A plot with one or several views, of which the reader chooses.

    Attributes:
        views: by what the reader chooses, Plotly's `data` and `layout`, and a `note` in words.
        height: pixels.
        label: what it shows, for readers who do not see it.
        orders: by what the reader chooses, the categories of the x axis; empty if their order is fixed.
        chooser: what the views differ in, the label of the choice.
    """

    views: Mapping[str, Mapping[str, Any]]
    height: int
    label: str
    orders: Mapping[str, Sequence[str]] = field(default_factory=dict)
    chooser: str = "Policy"


def safe(value: object) -> str:
    """Returns a text that Plotly shows as it is."""
    return html.escape(str(value), quote=False)


def view(data: Sequence[Trace], layout: Mapping[str, Any], note: str = "") -> dict[str, Any]:
    """Checks traces and layout with Plotly's own schema."""
    import plotly.graph_objects as go

    common: dict[str, Any] = {
        "font": {"family": _FONT, "size": 13, "color": INK},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "margin": {"l": 64, "r": 16, "t": 16, "b": 48},
        "hoverlabel": {"align": "left", "bgcolor": "white", "font": {"color": INK, "size": 12}},
        "legend": {"orientation": "h", "x": 0, "xanchor": "left", "y": 1.0, "yanchor": "bottom"},
        "modebar": {"bgcolor": "rgba(255,255,255,0.85)", "color": "#8a95a1", "activecolor": INK},
    }
    figure = go.Figure({"data": list(data), "layout": common | dict(layout)}).to_dict()
    figure["layout"].pop("template", None)
    return {"data": figure["data"], "layout": figure["layout"], "note": note}


def axis(title: str = "", **more: Any) -> dict[str, Any]:
    """Returns an axis in the common look; `more` are settings of Plotly's axes."""
    common = {
        "gridcolor": PALE,
        "zeroline": False,
        "automargin": True,
        "linecolor": "#9a9a9a",
        "ticks": "outside",
        "ticklen": 4,
    }
    return common | {"tickcolor": "#9a9a9a", "title": {"text": title, "standoff": 8}} | more


def job_style(k: int) -> tuple[str, str]:
    """Returns colour and marker of the k-th job."""
    return JOB_COLOURS[k % len(JOB_COLOURS)], _SYMBOLS[(k // len(JOB_COLOURS)) % len(_SYMBOLS)]


def zero_line(axis: str) -> dict[str, Any]:
    """Returns the line at 0 of the x axis or the y axis."""
    ends = (
        {"x0": 0, "x1": 0, "y0": 0, "y1": 1, "yref": "paper"}
        if axis == "x"
        else {"x0": 0, "x1": 1, "y0": 0, "y1": 0, "xref": "paper"}
    )
    return {"type": "line", "line": {"color": INK, "width": 1}, "layer": "below", **ends}


def cut(values: Array, what: str) -> tuple[float, str]:
    """Returns where an axis of improvements ends below, and a sentence if that cuts something off.

    The rule: an improvement is cut off if it lies further below the lower quartile than three times the distance between the
    quartiles (Tukey's far-out values), and only if it is worse than -60 %.
    """
    known = finite(values)
    if not len(known):
        return -1.0, ""
    q1, q3 = np.quantile(known, [0.25, 0.75])
    fence, lowest = min(float(q1 - 3 * (q3 - q1)), -0.6), float(known.min())
    if lowest >= fence:
        return min(lowest, 0.0), ""
    count = int((known < fence).sum())
    return (
        fence,
        f"The axis is cut at {percent(fence)}: {count} of {len(known)} {what}, the lowest to {percent(lowest)}.",
    )


def improvement_axis(baseline: str, low: float, high: float) -> dict[str, Any]:
    """Returns a vertical axis of improvements over a baseline from `low` to `high`, fractions, and a margin."""
    return axis(
        f"improvement over {LABELS.get(baseline, safe(baseline))}",
        tickformat=".0%",
        range=[low - 0.08 * (high - low), high + 0.05 * (high - low)],
    )
