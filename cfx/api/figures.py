"""Figures of pairs and forecasts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from cfx.data.pairs import Pair
from cfx.figures.canvas import Line, blank, draw_lines, method_legend, styled
from cfx.figures.colours import colour_of


def _panels(
    titles: Sequence[str], methods: tuple[str, str], labels: tuple[str, str]
) -> tuple[Figure, Any]:
    """Returns a figure with a legend, and its panels: a row per pair, a column per signal."""
    figure = blank(1.0 + 1.9 * len(titles))
    method_legend(figure, methods)
    panels = figure.subplots(len(titles), 2, squeeze=False)
    for row, title in zip(panels, titles, strict=True):
        row[0].set(title=title, ylabel=labels[0])
        row[1].set(ylabel=labels[1])
    for panel in panels[-1]:
        panel.set_xlabel("time (s)")
    return figure, panels


@styled
def draw_pairs(pairs: Sequence[Pair]) -> Figure:
    """Draws the recorded speeds of leader and follower, and the gap, of a few pairs."""
    names = [pair.pair_id for pair in pairs]
    figure, panels = _panels(names, ("leader", "real"), ("speed (m/s)", "gap (m)"))
    for row, pair in zip(panels, pairs, strict=True):
        time = np.arange(len(pair), dtype=np.float64) * np.float64(pair.dt)
        leader = Line("leader", time, pair.leader_speed)
        draw_lines(row[0], [leader, Line("real", time, pair.follower_speed)])
        draw_lines(row[1], [Line("real", time, pair.gap)])
    return figure


@styled
def draw_fans(pair_ids: Sequence[str], bands: pd.DataFrame, measured: pd.DataFrame) -> Figure:
    """Draws quantiles of forecasts over time, with what happened, a row of panels per pair.

    Args:
        pair_ids: which pairs.
        bands: index pair_id, time_s, quantile; columns speed and travelled.
        measured: columns pair_id, time_s, speed, travelled.
    """
    figure, panels = _panels(pair_ids, ("policy", "real"), ("speed (m/s)", "travelled (m)"))
    levels = sorted(bands.index.get_level_values("quantile").unique())
    for row, name in zip(panels, pair_ids, strict=True):
        real = measured[measured["pair_id"] == name]
        for panel, column in zip(row, ("speed", "travelled"), strict=True):
            of_pair = bands.loc[name].reset_index()
            table = of_pair.pivot_table(column, "time_s", "quantile")
            time = table.index.to_numpy(dtype=np.float64)
            colour = colour_of("policy")
            panel.fill_between(
                time, table[levels[0]], table[levels[-1]], color=colour, alpha=0.2, linewidth=0
            )
            middle = table[levels[len(levels) // 2]].to_numpy(dtype=np.float64)
            happened = Line(
                "real",
                real["time_s"].to_numpy(dtype=np.float64),
                real[column].to_numpy(dtype=np.float64),
            )
            draw_lines(panel, [Line("policy", time, middle), happened])
    return figure
