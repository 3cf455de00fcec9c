"""One pair over time: speed, gap and the parameters of each method."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from cfx.plots.choice.trajectories import TIME_TITLE, Collision, Line, Note, PairPanels, Panel
from cfx.plots.look import EDGE, colour_of
from cfx.plots.plotly.figure import Plot, Trace, axis, heading, safe, view
from cfx.plots.words import label

DASHES: Mapping[str, str] = {
    "default": "dot",
    "population": "dashdot",
    "fixed": "dash",
    "shrunk": "longdashdot",
    "constant_speed": "dot",
    "constant_acceleration": "dash",
    "population_residual": "dashdot",
    "fixed_residual": "dash",
    "population_ar": "dot",
    "fixed_ar": "dot",
    "policy_sampled": "dot",
}
WIDTHS: Mapping[str, float] = {"real": 2.2, "leader": 1.2, "policy": 2.2}


def pair_plot(pair: PairPanels) -> Plot:
    """Speed, gap and each tuned parameter of one pair over the test part."""
    columns = 2 if len(pair.parameters) <= 4 else 4
    grid = _Grid(columns, -(-len(pair.parameters) // columns))
    data: list[Trace] = []
    layout: dict[str, Any] = {
        "annotations": [],
        "shapes": [],
        "margin": {"l": 56, "r": 12, "t": 58, "b": 44},
        "hovermode": "x",
    }
    _add_panel(data, layout, pair.speed, "", grid.half(0), grid.top(), title=pair.speed.title)
    _add_panel(data, layout, pair.gap, "2", grid.half(1), grid.top(), title=pair.gap.title)
    small: dict[str, Any] = {"nticks": 4, "tickfont": {"size": 11}}
    for k, panel in enumerate(pair.parameters):
        across, down = grid.cell(k)
        _add_panel(data, layout, panel, str(k + 3), across, down, **small)
        said = heading(safe(panel.title), across[0], down[1])
        layout["annotations"].append(said | {"hovertext": safe(panel.meaning)})
    place = {"x": 0.5, "y": 0, "yshift": -42, "xref": "paper", "yref": "paper"}
    layout["annotations"].append({"text": TIME_TITLE, "showarrow": False, **place})
    title = f"Speed, gap and parameters of pair {pair.pair_id}"
    return Plot({"": view(data, layout)}, grid.height, title)


def line_trace(line: Line, number: str = "", *, legend: bool = True) -> Trace:
    """Returns a line in its method's colour and dash.

    Args:
        line: what is drawn.
        number: of the axes.
        legend: whether it stands in the legend.
    """
    time, values = line.time, line.values
    if line.steps and len(values) > 2 and bool((values == values[0]).all()):
        # A constant needs its two ends alone.
        time, values = time[[0, -1]], values[[0, -1]]
    name = safe(label(line.method))
    trace: Trace = {
        "type": "scatter",
        "mode": "lines",
        "x": time.astype(np.float32),
        "y": values.astype(np.float32),
        "xaxis": f"x{number}",
        "yaxis": f"y{number}",
        "name": name,
        "legendgroup": line.method,
        "showlegend": legend,
        "line": {
            "color": colour_of(line.method),
            "width": WIDTHS.get(line.method, 1.8),
            "dash": DASHES.get(line.method, "solid"),
            "shape": "hv" if line.steps else "linear",
        },
        "hovertemplate": f"{name} %{{y:.3g}}<extra></extra>",
    }
    if line.hidden:
        trace["visible"] = "legendonly"
    return trace


def _add_panel(
    data: list[Trace],
    layout: dict[str, Any],
    panel: Panel,
    number: str,
    across: list[float],
    down: list[float],
    title: str = "",
    **more: Any,
) -> None:
    """Adds the axes and the lines of a panel; the legend is that of the first panel."""
    matches = {"matches": "x"} if number else {}
    ends = {}
    if panel.low is not None and panel.high is not None:
        ends = {"range": [panel.low, panel.high]}
        layout["shapes"] += _bounds(panel, panel.low, panel.high, number)
    layout[f"xaxis{number}"] = axis(domain=across, anchor=f"y{number}", **matches)
    layout[f"yaxis{number}"] = axis(title, domain=down, anchor=f"x{number}", **ends, **more)
    for line in panel.lines:
        data.append(line_trace(line, number, legend=not number))
    for note in panel.notes:
        layout["annotations"].append(_note(note, number))
    for collision in panel.collisions:
        data.append(_collision(collision, number))


def _bounds(panel: Panel, low: float, high: float, number: str) -> list[dict[str, Any]]:
    """Returns a line at each bound of a parameter that is in view."""
    shapes = []
    for bound in panel.bounds or ():
        if low <= bound <= high:
            ends = {"x0": 0, "x1": 1, "y0": bound, "y1": bound}
            references = {"xref": f"x{number} domain", "yref": f"y{number}", "layer": "below"}
            look = {"type": "line", "line": {"color": EDGE, "width": 1}}
            shapes.append(look | references | ends)
    return shapes


def _note(note: Note, number: str) -> dict[str, Any]:
    height, aligned = (0.98, "top") if note.above else (0.02, "bottom")
    return {
        "text": safe(note.text),
        "x": 0.99,
        "y": height,
        "xref": f"x{number} domain",
        "yref": f"y{number} domain",
        "xanchor": "right",
        "yanchor": aligned,
        "showarrow": False,
        "font": {"size": 11, "color": colour_of(note.method)},
    }


def _collision(collision: Collision, number: str) -> Trace:
    return {
        "type": "scatter",
        "mode": "markers",
        "x": [collision.time],
        "y": [collision.gap],
        "xaxis": f"x{number}",
        "yaxis": f"y{number}",
        "name": collision.text,
        "legendgroup": collision.method,
        "showlegend": False,
        "marker": {"symbol": "x", "size": 9, "color": colour_of(collision.method)},
        "hovertemplate": f"{safe(collision.text)}<extra></extra>",
    }


class _Grid:
    """Where the panels lie: speed and gap above, the parameters below in a grid; pixels."""

    _TOP, _ROW, _GAP = 260, 120, 58

    def __init__(self, columns: int, rows: int) -> None:
        self.columns = columns
        self._inner = self._TOP + rows * (self._ROW + self._GAP)
        self.height = self._inner + 102

    def top(self) -> list[float]:
        return [1 - self._TOP / self._inner, 1.0]

    def half(self, k: int) -> list[float]:
        return [0.0, 0.455] if k == 0 else [0.545, 1.0]

    def cell(self, k: int) -> tuple[list[float], list[float]]:
        row, column = divmod(k, self.columns)
        space = 0.06 if self.columns == 2 else 0.05
        width = (1 - space * (self.columns - 1)) / self.columns
        left = column * (width + space)
        top = 1 - (self._TOP + self._GAP + row * (self._ROW + self._GAP)) / self._inner
        return [left, left + width], [max(0.0, top - self._ROW / self._inner), top]
