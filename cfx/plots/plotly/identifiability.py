"""Slices of the loss, fits on both parts, and labels over time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from cfx.calibration.flatness import NEAR
from cfx.plots.choice.identifiability import (
    HIGHEST,
    RATIO_TITLE,
    DriverLabels,
    Fit,
    SlicePanel,
)
from cfx.plots.choice.trajectories import TIME_TITLE, ParameterAxis
from cfx.plots.look import EDGE, INK, colour_of
from cfx.plots.plotly.figure import Plot, Trace, axes_number, axis, safe, safe_all, view
from cfx.plots.words import label, percent, short, unit_label

_SYMBOLS = {"fixed": "circle", "population": "diamond-open", "default": "line-ns-open"}


def slices_plot(panels: Sequence[SlicePanel]) -> Plot:
    """The loss along each parameter, a view per parameter."""
    views = {}
    for panel in panels:
        name = unit_label(panel.axis.name, panel.axis.unit)
        near, share = percent(NEAR).lstrip("+"), percent(panel.near).lstrip("+")
        note = f"Within {near} of the best loss on {share} of the range (median over pairs)."
        views[name] = view(_slices(panel), _slice_layout(name), note)
    title = "The loss when one parameter is moved and the others are held"
    return Plot(views, 320, title, chooser="Parameter")


def _slices(panel: SlicePanel) -> list[Trace]:
    data: list[Trace] = []
    look = {"color": colour_of("fixed"), "width": 1}
    shown = np.minimum(panel.lines, 10 * HIGHEST)
    for ratios in shown:
        data.append(
            {
                "type": "scatter",
                "mode": "lines",
                "x": panel.values,
                "y": ratios,
                "line": look,
                "opacity": 0.2,
                "hoverinfo": "skip",
                "showlegend": False,
            }
        )
    data.append(
        {
            "type": "scatter",
            "mode": "lines",
            "name": "median over pairs",
            "x": panel.values,
            "y": np.minimum(panel.median, 10 * HIGHEST),
            "line": {"color": INK, "width": 3},
            "hovertemplate": "%{x:.3g}: %{y:.2f} times the best<extra></extra>",
        }
    )
    return data


def _slice_layout(name: str) -> dict[str, Any]:
    ends = {"x0": 0, "x1": 1, "xref": "paper", "y0": 1 + NEAR, "y1": 1 + NEAR}
    near = {"type": "line", "line": {"color": EDGE, "width": 1, "dash": "dash"}, **ends}
    return {
        "xaxis": axis(safe(name)),
        "yaxis": axis(RATIO_TITLE, range=[0.97, HIGHEST]),
        "shapes": [near],
    }


def fits_plot(fits: Sequence[Fit]) -> Plot:
    """Each pair's error on the part that was calibrated on, against that on the test part."""
    data: list[Trace] = []
    highest = 0.0
    for fit in fits:
        highest = max(highest, float(np.quantile(np.concatenate([fit.train, fit.test]), 0.98)))
        data.append(
            {
                "type": "scatter",
                "mode": "markers",
                "name": label(fit.method),
                "x": fit.train,
                "y": fit.test,
                "text": safe_all(fit.pair_ids),
                "marker": {
                    "symbol": _SYMBOLS[fit.method],
                    "color": colour_of(fit.method),
                    "size": 7,
                    "opacity": 0.7,
                },
                "hovertemplate": "%{text}: %{x:.2f} and %{y:.2f} m/s<extra></extra>",
            }
        )
    end = 1.15 * highest
    same = {"type": "line", "x0": 0, "y0": 0, "x1": end, "y1": end, "layer": "below"}
    layout = {
        "xaxis": axis("RMSE of speed on the part calibrated on (m/s)", range=[0, end]),
        "yaxis": axis("on the test part (m/s)", range=[0, end]),
        "shapes": [{**same, "line": {"color": EDGE, "width": 1}}],
    }
    return Plot({"": view(data, layout)}, 420, "Errors where calibrated, and on the test part")


def labels_plot(drivers: Sequence[DriverLabels], axes: Sequence[ParameterAxis]) -> Plot:
    """Per-window calibrated parameters over time, a view per pair."""
    views = {}
    rows = 1
    for driver in drivers:
        shown = [one for one in axes if one.name in driver.values]
        rows = len(shown) + 1
        views[short(driver.pair_id)] = _labels(driver, shown)
    title = "Per-window calibrated parameters over time, and how much they mattered"
    return Plot(views, 80 + 95 * rows, title, chooser="Pair")


def _labels(driver: DriverLabels, shown: Sequence[ParameterAxis]) -> dict[str, Any]:
    data: list[Trace] = []
    layout: dict[str, Any] = {"shapes": [], "showlegend": False}
    rows = len(shown) + 1
    height = 1 / rows
    for k, one in enumerate(shown):
        number = axes_number(k)
        domain = [1 - (k + 0.86) * height, 1 - k * height]
        layout[f"yaxis{number}"] = axis(
            safe(unit_label(one.name, one.unit)), domain=domain, anchor="x"
        )
        data.append(
            {
                "type": "scatter",
                "mode": "markers",
                "x": driver.time,
                "y": driver.values[one.name],
                "yaxis": f"y{number}",
                "marker": {
                    "size": 5,
                    "color": colour_of("policy"),
                    "opacity": np.maximum(driver.weight, 0.08),
                },
                "hovertemplate": "%{x:.1f} s: %{y:.3g}<extra></extra>",
            }
        )
        ends = {"x0": 0, "x1": 1, "xref": "x domain", "yref": f"y{number}"}
        value = driver.fixed[one.name]
        look = {"type": "line", "line": {"color": colour_of("fixed"), "width": 2}}
        layout["shapes"].append({**look, **ends, "y0": value, "y1": value})
    number = axes_number(len(shown))
    layout[f"yaxis{number}"] = axis("sensitivity", domain=[0, 0.86 * height], anchor="x")
    layout["xaxis"] = axis(TIME_TITLE, anchor=f"y{number}")
    data.append(
        {
            "type": "scatter",
            "mode": "lines",
            "x": driver.time,
            "y": driver.sensitivity,
            "yaxis": f"y{number}",
            "line": {"color": INK, "width": 1},
            "hovertemplate": "%{x:.1f} s: %{y:.3g}<extra></extra>",
        }
    )
    return view(data, layout)
