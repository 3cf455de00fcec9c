"""What a drawing holds."""

from __future__ import annotations

from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure


def drawn_lines(axes: Axes) -> dict[str, Any]:
    """Returns the lines by colour, those of references and marks left out."""
    found = {}
    for line in axes.lines:
        if len(line.get_xdata()) > 2:
            found[line.get_color()] = line
    return found


def texts(figure: Figure) -> str:
    """Everything written in a figure."""
    return "\n".join(artist.get_text() for artist in figure.findobj(mpl.text.Text))
