"""Learning curves."""

from __future__ import annotations

from typing import Any

from cfx.plots.choice.learning import LOSS_TITLE, SAMPLED, LearningCurves, LossCurve
from cfx.plots.look import EDGE
from cfx.plots.plotly.figure import Plot, Trace, axis, view


def learning_plot(curves: LearningCurves) -> Plot:
    """Loss by epoch: the median over the networks and the quartiles."""
    data: list[Trace] = []
    for curve in curves.curves:
        if curves.networks > 1:
            data += _band(curve)
        data.append(_median(curve))
    legend = {"title": {"text": f"{curves.title}  "}, "orientation": "h", "x": 0}
    layout: dict[str, Any] = {
        "xaxis": axis("epoch"),
        "yaxis": _loss_axis(curves),
        "hovermode": "x unified",
        "legend": {**legend, "y": 1.0, "yanchor": "bottom"},
    }
    if curves.sampled_from is not None:
        shape: dict[str, Any] = {"type": "line", "yref": "y domain"}
        shape |= {"x0": curves.sampled_from, "x1": curves.sampled_from, "y0": 0, "y1": 1}
        shape["line"] = {"color": EDGE, "width": 1, "dash": "dash"}
        shape["label"] = {"text": SAMPLED, "textposition": "end", "textangle": 0, "xanchor": "left"}
        layout["shapes"] = [shape]
    return Plot({"": view(data, layout)}, 320, f"Learning curves, {curves.title}")


def _median(curve: LossCurve) -> Trace:
    dash = "dash" if curve.dashed else "solid"
    return {
        "type": "scatter",
        "mode": "lines" if len(curve.epochs) > 2 else "lines+markers",
        "x": curve.epochs,
        "y": curve.median,
        "name": curve.label,
        "legendgroup": curve.label,
        "line": {"color": curve.colour, "width": 2.4, "dash": dash},
        "hovertemplate": f"{curve.label}, epoch %{{x}}: %{{y:.4g}}<extra></extra>",
    }


def _band(curve: LossCurve) -> list[Trace]:
    common: Trace = {
        "type": "scatter",
        "mode": "lines",
        "x": curve.epochs,
        "legendgroup": curve.label,
        "line": {"width": 0},
        "hoverinfo": "skip",
        "showlegend": False,
    }
    filled = {"fill": "tonexty", "fillcolor": _faint(curve.colour)}
    return [common | {"y": curve.low}, common | {"y": curve.high} | filled]


def _loss_axis(curves: LearningCurves) -> dict[str, Any]:
    if not curves.logarithmic:
        return axis(LOSS_TITLE)
    return axis(
        LOSS_TITLE,
        type="log",
        tickmode="array",
        tickvals=list(curves.ticks),
        ticktext=[f"{tick:.2g}" for tick in curves.ticks],
    )


def _faint(colour: str) -> str:
    red, green, blue = (int(colour[k : k + 2], 16) for k in (1, 3, 5))
    return f"rgba({red},{green},{blue},0.25)"
