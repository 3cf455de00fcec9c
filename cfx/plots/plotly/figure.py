"""What all plots of a report share: the plot that a page draws when it comes into view, axes.

Every text from data is escaped: Plotly reads tags such as `<a href=...>` in names and labels.
"""

from __future__ import annotations

import html
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from cfx.plots.choice.improvements import ImprovementAxis
from cfx.plots.look import INK, JOB_COLOURS, PALE

Trace = dict[str, Any]

_SYMBOLS = ("circle", "square", "diamond", "cross", "x", "star", "hexagon", "pentagon")
_FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, sans-serif"


@dataclass(frozen=True)
class Plot:
    """A plot with one or several views, of which the reader chooses.

    Attributes:
        views: by what the reader chooses, Plotly's `data` and `layout`, and a `note` in words.
        height: pixels.
        label: what it shows, for readers who do not see it.
        orders: by what the reader chooses, the categories of the x axis; empty if their order is
            fixed.
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


def safe_all(values: Iterable[object]) -> list[str]:
    """Returns texts that Plotly shows as they are."""
    return [safe(value) for value in values]


def axes_number(k: int) -> str:
    """Returns how Plotly names the k-th pair of axes: "", "2", "3"."""
    return str(k + 1) if k else ""


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
        "tickcolor": "#9a9a9a",
        "title": {"text": title, "standoff": 8},
    }
    return common | more


def improvement_axis(chosen: ImprovementAxis, *, upright: bool = True) -> dict[str, Any]:
    """Returns an axis of improvements, percent; an upright one has its title in two lines."""
    title = chosen.title
    if upright:
        title = title.replace(" over ", "<br>over ")
    return axis(title, range=[chosen.low, chosen.high], tickformat=".0%")


def job_style(k: int) -> tuple[str, str]:
    """Returns colour and marker of the k-th job."""
    colours = len(JOB_COLOURS)
    return JOB_COLOURS[k % colours], _SYMBOLS[(k // colours) % len(_SYMBOLS)]


def zero_line(axis: str) -> dict[str, Any]:
    """Returns the line at 0 of the x axis or the y axis."""
    if axis == "x":
        ends = {"x0": 0, "x1": 0, "y0": 0, "y1": 1, "yref": "paper"}
    else:
        ends = {"x0": 0, "x1": 1, "y0": 0, "y1": 0, "xref": "paper"}
    return {"type": "line", "line": {"color": INK, "width": 1}, "layer": "below", **ends}


def heading(text: str, x: float, y: float, size: int = 12) -> dict[str, Any]:
    """Returns the title of a panel, bold, above its upper left corner; x and y in shares."""
    return {
        "text": f"<b>{text}</b>",
        "x": x,
        "y": y,
        "xref": "paper",
        "yref": "paper",
        "xanchor": "left",
        "yanchor": "bottom",
        "showarrow": False,
        "font": {"size": size},
    }
