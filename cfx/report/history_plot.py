"""What a policy gains from the history that it has read: plot and table."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cfx.figures.look import COLOURS, INK, percent
from cfx.report.figure import Plot, Trace, axis, safe, view, zero_line
from cfx.report.read import Job
from cfx.report.tables import Column, Sheet, interval, number, share, text


def history(job: Job) -> Plot:
    """Mean improvement over the driver's own fixed parameters and its 95 % interval by the amount of history; a line per base.

    Args:
        job: has a history.
    """
    from cfx.figures.history import BASE_LABELS, BASES, amounts_of, history_means  # imports torch

    assert job.history is not None
    data: list[Trace] = []
    for base, means in history_means(job.history).items():
        mean, low, high = (means[name].to_numpy(dtype=float) for name in ("mean", "low", "high"))
        colour, label = COLOURS.get(BASES.get(base, ""), INK), BASE_LABELS.get(base, safe(base))
        data.append(
            {
                "type": "scatter",
                "mode": "lines+markers",
                "name": label,
                "x": [safe(amount) for amount in means.index],
                "y": mean,
                "error_y": {
                    "type": "data",
                    "symmetric": False,
                    "array": high - mean,
                    "arrayminus": mean - low,
                    "width": 5,
                },
                "marker": {"size": 9, "color": colour},
                "line": {"color": colour, "width": 2},
                "text": [
                    f"{label}<br>{safe(amount)}: {percent(m, 1)}, 95 % interval {percent(a, 1)} to {percent(b, 1)}"
                    for amount, m, a, b in zip(means.index, mean, low, high, strict=True)
                    if np.isfinite(m)
                ],
                "hovertemplate": "%{text}<extra></extra>",
            }
        )
    order = [safe(amount) for amount in amounts_of(job.history)]
    layout = {
        "xaxis": axis(
            "measured history read before the test part",
            type="category",
            categoryorder="array",
            categoryarray=order,
        ),
        "yaxis": axis("improvement over own fixed", tickformat=".0%"),
        "shapes": [zero_line("y")],
    }
    return Plot({"": view(data, layout)}, 360, "Improvement by the amount of history read")


def histories(jobs: Sequence[Job]) -> Sheet:
    """Returns a row per job, base and amount."""
    from cfx.figures.history import BASE_LABELS, history_means

    columns = (
        Column("Job", "", number=False),
        Column("Base", "What the policy's answers are offsets from.", number=False),
        Column(
            "History read",
            "Measured history before the test part; a share is of the whole drive.",
            number=False,
        ),
        Column(
            "Mean",
            "Mean improvement of the RMSE of speed over the driver's own fixed parameters, on the test part.",
        ),
        Column(
            "95 % interval",
            "Bootstrap confidence interval of the mean; drivers are drawn, each with all his pairs.",
        ),
        Column("Pairs", "Pairs whose improvement is defined."),
    )
    rows = [
        (
            text(job.name),
            text(BASE_LABELS.get(base, base)),
            text(amount),
            share(float(row["mean"])),
            interval(float(row["low"]), float(row["high"])),
            number(float(row["pairs"]), f"{row['pairs']:.0f}"),
        )
        for job in jobs
        if job.history is not None
        for base, means in history_means(job.history).items()
        for amount, row in means.iterrows()
    ]
    return Sheet(columns, tuple(rows))
