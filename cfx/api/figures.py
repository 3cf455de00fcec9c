"""What notebooks show of pairs and fits: figures, and tables as HTML."""

from __future__ import annotations

import html
import io
from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from cfx.data.pairs import Pair
from cfx.report.figures.canvas import Line, canvas, draw_lines, figure_style, method_legend, styled

_ROWS = 10
"""Most rows of a table that a notebook shows."""


def as_html(text: str, table: pd.DataFrame) -> str:
    """Returns a line and the beginning of a table as HTML."""
    shown = table.head(_ROWS).to_html(float_format=lambda value: f"{value:.3g}", border=0)
    more = ""
    if len(table) > _ROWS:
        more = f"<p>{len(table) - _ROWS} more rows</p>"
    return f"<p>{html.escape(text)}</p>{shown}{more}"


def for_notebooks(figure: Figure) -> Figure:
    """Returns a figure that notebooks show by themselves; pyplot knows nothing of it."""

    def as_png() -> bytes:
        stream = io.BytesIO()
        with figure_style():
            figure.savefig(stream, format="png")
        return stream.getvalue()

    vars(figure)["_repr_png_"] = as_png
    return figure


@styled
def draw_pairs(pairs: Sequence[Pair]) -> Figure:
    """Draws the recorded speeds of leader and follower, and the gap, of a few pairs."""
    figure = canvas(1.0 + 1.9 * len(pairs))
    method_legend(figure, ("leader", "real"))
    panels = figure.subplots(len(pairs), 2, squeeze=False)
    for row, pair in zip(panels, pairs, strict=True):
        time = np.arange(len(pair), dtype=np.float64) * np.float64(pair.dt)
        speeds = [
            Line("leader", time, pair.leader_speed),
            Line("real", time, pair.follower_speed),
        ]
        draw_lines(row[0], speeds)
        draw_lines(row[1], [Line("real", time, pair.gap)])
        row[0].set(title=pair.pair_id, ylabel="speed (m/s)")
        row[1].set(ylabel="gap (m)")
    for panel in panels[-1]:
        panel.set_xlabel("time (s)")
    return figure
