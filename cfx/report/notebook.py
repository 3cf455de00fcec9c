"""What a notebook shows of results by itself: tables as HTML, and figures."""

from __future__ import annotations

import html
import io
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

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
    from cfx.report.figures.canvas import figure_style

    def as_png() -> bytes:
        stream = io.BytesIO()
        with figure_style():
            figure.savefig(stream, format="png")
        return stream.getvalue()

    vars(figure)["_repr_png_"] = as_png
    return figure
