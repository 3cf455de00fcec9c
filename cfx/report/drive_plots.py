"""Plots of single drives: speed, gap and parameters over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from cfx.figures.look import COLOURS, LABELS, unit_label
from cfx.report.figure import Plot, Trace, axis, safe, view
from cfx.report.read import Job, finite

_DASHES = {
    "real": "solid",
    "leader": "solid",
    "default": "dot",
    "population": "dashdot",
    "fixed": "dash",
    "shrunk": "longdashdot",
    "policy": "solid",
}
_WIDTHS = {"real": 2.2, "leader": 1.2, "policy": 2.2}


@dataclass(frozen=True)
class Chosen:
    """A drive worth looking at: how it ranks, and which pair it is."""

    rank: str
    pair_id: str
    improvement: float


def chosen_trajectories(job: Job) -> list[Chosen]:
    """Returns the best, the median and the worst pair by improvement over the fixed parameters; fewer if there are fewer."""
    if job.drives is None:
        return []
    known = set(job.drives["pair_id"])
    table = job.by_pair
    table = table[table["pair_id"].isin(known) & np.isfinite(table["improvement/fixed"])]
    ranked = table.sort_values("improvement/fixed", ascending=False, kind="stable")
    count = len(ranked)
    places = (
        {0: "best", count // 2: "median", count - 1: "worst"}
        if count > 2
        else dict(enumerate(("best", "worst")[:count]))
    )
    return [
        Chosen(
            rank, str(ranked["pair_id"].iloc[place]), float(ranked["improvement/fixed"].iloc[place])
        )
        for place, rank in sorted(places.items())
    ]


def drive(job: Job, pair_id: str) -> Plot:
    """Speed, gap and each tuned parameter over the test part of one pair.

    A parameter's axis shows at least a fifth of its range, so that a small change looks small.

    Args:
        job: has drives; units and bounds of the parameters are shown where the job wrote them down.
        pair_id: one of its pairs.
    """
    assert job.drives is not None
    frames = job.drives[job.drives["pair_id"] == pair_id]
    methods = [method for method in job.methods if f"speed_{method}" in frames]
    names = parameter_names(job.drives, methods)
    columns = 2 if len(names) <= 4 else 4
    rows = -(-len(names) // columns)
    grid = _Grid(columns, rows)
    known = {
        str(one.get("name")): one
        for one in job.data.get("parameters") or ()
        if isinstance(one, Mapping)
    }
    data = _lines(frames, "speed", methods, "", leader=True) + _lines(
        frames, "gap", methods, "2", leader=False
    )
    layout: dict[str, Any] = {
        "xaxis": axis(domain=grid.half(0), anchor="y"),
        "yaxis": axis(
            "speed (m/s)", domain=grid.top(), anchor="x", **_window(frames, "speed", methods)
        ),
        "xaxis2": axis(domain=grid.half(1), anchor="y2", matches="x"),
        "yaxis2": axis(
            "gap (m)", domain=grid.top(), anchor="x2", **_window(frames, "gap", methods)
        ),
        "annotations": [],
        "margin": {"l": 56, "r": 12, "t": 30, "b": 44},
        "hovermode": "x",
    }
    for k, name in enumerate(names):
        number = str(k + 3)
        data += _parameter_lines(frames, name, methods, number)
        across, down = grid.cell(k)
        layout[f"xaxis{number}"] = axis(domain=across, anchor=f"y{number}", matches="x")
        layout[f"yaxis{number}"] = axis(
            domain=down,
            anchor=f"x{number}",
            nticks=4,
            tickfont={"size": 11},
            **_at_least(frames, name, methods, known.get(name, {})),
        )
        label = safe(unit_label(name, str(known.get(name, {}).get("unit", ""))))
        layout["annotations"].append(
            {
                "text": f"<b>{label}</b>",
                "x": across[0],
                "y": down[1],
                "xref": "paper",
                "yref": "paper",
                "xanchor": "left",
                "yanchor": "bottom",
                "showarrow": False,
                "font": {"size": 12},
            }
        )
    layout["annotations"].append(
        {
            "text": "time from the start of the pair (s)",
            "x": 0.5,
            "y": 0,
            "yshift": -42,
            "xref": "paper",
            "yref": "paper",
            "showarrow": False,
        }
    )
    return Plot(
        {"": view(data, layout)}, grid.height, f"Speed, gap and parameters of pair {pair_id}"
    )


class _Grid:
    """Where the panels of a drive lie: speed and gap above, the parameters below in a grid."""

    _TOP, _ROW, _GAP = 260, 120, 58

    def __init__(self, columns: int, rows: int) -> None:
        self.columns = columns
        self._inner = self._TOP + rows * (self._ROW + self._GAP)
        self.height = self._inner + 80

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


def parameter_names(drives: pd.DataFrame, methods: Sequence[str]) -> list[str]:
    """Returns the tuned parameters: what has a column for every method, besides speed and gap."""
    suffix = f"_{methods[-1]}"
    names = [str(column).removesuffix(suffix) for column in drives if str(column).endswith(suffix)]
    return [
        name
        for name in names
        if name not in {"speed", "gap"} and all(f"{name}_{m}" in drives for m in methods)
    ]


def _lines(
    frames: pd.DataFrame, signal: str, methods: Sequence[str], axis: str, *, leader: bool
) -> list[Trace]:
    shown = [
        *([("leader", "leader_speed")] if leader else []),
        ("real", f"real_{signal}"),
        *((m, f"{signal}_{m}") for m in methods),
    ]
    return [_line(frames, column, method, axis, legend=leader) for method, column in shown]


def _line(
    frames: pd.DataFrame, column: str, method: str, axis: str, *, legend: bool, steps: bool = False
) -> Trace:
    time, values = frames["time_s"].to_numpy(dtype=float), frames[column].to_numpy(dtype=float)
    values = np.where(np.isfinite(values), values, np.nan)
    if (
        steps and len(values) > 2 and bool((values == values[0]).all())
    ):  # a constant needs its two ends alone
        time, values = time[[0, -1]], values[[0, -1]]
    label = LABELS.get(method, safe(method))
    return {
        "type": "scatter",
        "mode": "lines",
        "x": time.astype(np.float32),
        "y": values.astype(np.float32),
        "xaxis": f"x{axis}",
        "yaxis": f"y{axis}",
        "name": label,
        "legendgroup": method,
        "showlegend": legend,
        "line": {
            "color": COLOURS.get(method, "#777777"),
            "width": _WIDTHS.get(method, 1.8),
            "dash": _DASHES.get(method, "longdash"),
            "shape": "hv" if steps else "linear",
        },
        "hovertemplate": f"{label} %{{y:.3g}}<extra></extra>",
    }


def _parameter_lines(
    frames: pd.DataFrame, name: str, methods: Sequence[str], axis: str
) -> list[Trace]:
    return [
        _line(frames, f"{name}_{method}", method, axis, legend=False, steps=True)
        for method in methods
    ]


def _at_least(
    frames: pd.DataFrame, name: str, methods: Sequence[str], parameter: Mapping[str, Any]
) -> dict[str, Any]:
    """Returns a range of at least a fifth of the parameter's; nothing if its bounds are not known."""
    values = finite(
        frames[[f"{name}_{method}" for method in methods]].to_numpy(dtype=float).ravel()
    )
    low, high = parameter.get("low"), parameter.get("high")
    if not (len(values) and isinstance(low, int | float) and isinstance(high, int | float)):
        return {}
    half = max(1.15 * float(np.ptp(values)), 0.2 * (high - low)) / 2
    centre = (float(values.min()) + float(values.max())) / 2
    return {"range": [centre - half, centre + half]} if half > 0 else {}


def _window(frames: pd.DataFrame, signal: str, methods: Sequence[str]) -> dict[str, Any]:
    """Returns the first view of an axis: a default driver far off the others stretches it by at most 1.5 times their range."""
    near = [
        "real_" + signal,
        *(f"{signal}_{m}" for m in methods if m != "default"),
        *(["leader_speed"] if signal == "speed" else []),
    ]
    close, far = (
        finite(frames[near].to_numpy(dtype=float).ravel()),
        finite(frames.get(f"{signal}_default", pd.Series(dtype=float))),
    )
    if not len(close):
        return {}
    height = max(float(np.ptp(close)), 1.0)
    low = max(
        min(float(close.min()), float(far.min(initial=np.inf))), float(close.min()) - 1.5 * height
    )
    high = min(
        max(float(close.max()), float(far.max(initial=-np.inf))), float(close.max()) + 1.5 * height
    )
    return {"range": [low - 0.06 * height, high + 0.06 * height]}
