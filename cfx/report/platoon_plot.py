"""Plot of the platoons: speeds of a leader that brakes and of the ten who follow."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from cfx.figures.look import COLOURS, LABELS
from cfx.figures.platoon import braking_time, vehicle_colour, worst_platoon
from cfx.report.figure import Plot, Trace, axis, safe, view
from cfx.report.read import Job

_BEFORE, _STEP = 10.0, 5
"""Seconds shown before the leader brakes; every so many-th frame is drawn."""


def platoon(job: Job) -> Plot:
    """Speeds over time, a panel per method; of several networks the one whose last follower slows down most.

    Args:
        job: has a platoon.
    """
    assert job.platoon is not None
    methods = [method for method in job.methods if method in set(job.platoon["method"])]
    methods = (
        methods
        if job.has_constant_baseline
        else [method for method in methods if method == "policy"]
    )
    data: list[Trace] = []
    layout: dict[str, Any] = {
        "annotations": [],
        "margin": {"l": 56, "r": 12, "t": 40, "b": 44},
        "showlegend": False,
    }
    for k, method in enumerate(methods):
        suffix = str(k + 1) if k else ""
        of_method = job.platoon[job.platoon["method"] == method]
        rows, network = worst_platoon(of_method)
        data += _lines(rows, suffix)
        domain = [k / len(methods) + (0.02 if k else 0), (k + 1) / len(methods) - 0.02]
        layout[f"xaxis{suffix}"] = axis(
            "time from braking (s)", domain=domain, anchor=f"y{suffix}", matches="x" if k else None
        )
        layout[f"yaxis{suffix}"] = axis(
            "" if k else "speed (m/s)", anchor=f"x{suffix}", matches="y" if k else None
        )
        of_many = f" ({safe(network)})" if len(of_method["network"].unique()) > 1 else ""
        heading = f"<b>{LABELS.get(method, safe(method))}</b>{of_many}"
        place = {
            "x": domain[0],
            "y": 1.02,
            "xref": "paper",
            "yref": "paper",
            "xanchor": "left",
            "yanchor": "bottom",
        }
        layout["annotations"].append({"text": heading, "showarrow": False, **place})
    return Plot({"": view(data, layout)}, 330, "Speeds of ten followers behind a braking leader")


def _lines(rows: pd.DataFrame, suffix: str) -> list[Trace]:
    begin, last = braking_time(rows), int(rows["vehicle"].max())
    shown = rows[rows["time_s"] >= begin - _BEFORE]
    traces = []
    for number, drive in shown.groupby("vehicle", sort=True):
        k, kept = int(str(number).partition(".")[0]), drive.iloc[::_STEP]
        name = "leader" if k == 0 else f"follower {k}"
        hit = " (collides)" if bool((drive["gap"] < 0).any()) else ""
        traces.append(
            {
                "type": "scatter",
                "mode": "lines",
                "x": np.round(kept["time_s"].to_numpy() - begin, 2),
                "y": np.round(kept["speed"].to_numpy(dtype=float), 2),
                "xaxis": f"x{suffix}",
                "yaxis": f"y{suffix}",
                "name": name,
                "line": {
                    "width": 2.4 if k == 0 else 1.4,
                    "color": COLOURS["real"] if k == 0 else vehicle_colour(k, last),
                },
                "hovertemplate": f"{name}{hit}: %{{y:.2f}} m/s at %{{x:.1f}} s<extra></extra>",
            }
        )
    return [*traces[1:], traces[0]]
