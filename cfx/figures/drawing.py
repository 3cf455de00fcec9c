"""How a job's figures are found, drawn in the common look, and written.

The result of which a figure is drawn is passed on as it is: only figures look into it.
"""

from __future__ import annotations

import html
import io
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from cfx.core import registry
from cfx.core.distributions import install_line
from cfx.core.files import atomic_write
from cfx.errors import DataError, OutputError, listed, nearest

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "FIGURE_METADATA",
    "draw_figure",
    "figure_named",
    "write_figure",
    "write_figures",
]
"""What plugins may use, as `cfx.plugin.drawing`."""


log = logging.getLogger(__name__)


def where_figures_are() -> str:
    """Returns how figures of jobs are installed."""
    return f"Figures of jobs come with cfx-report: {install_line('cfx-report')}"


def figure_named(name: str) -> registry.Installed[Any]:
    """Returns the figure of a name.

    Raises:
        DataError: there is none that works.
    """
    figures = {figure.name: figure for figure in registry.installed("figure")}
    if name in figures:
        return figures[name]
    if not figures:
        raise DataError(f"there is no figure '{name}'. {where_figures_are()}")
    raise DataError(
        f"there is no figure '{name}'.{nearest(name, figures)} Known: {listed(list(figures))}."
    )


def draw_figure(figure: registry.Installed[Any], result: Any) -> Figure | None:
    """Returns a figure in the common look; None where there is nothing to show, or it fails.

    Args:
        figure: as `figure_named` returns it.
        result: a `cfx.results.result.Result`.
    """
    from cfx.figures.canvas import figure_style

    def attempt(component: Any) -> Figure | None:
        with figure_style():
            drawing: Figure | None = component.draw(result)
            return drawing

    return figure.attempt(attempt, None)


FIGURE_METADATA: dict[str, dict[str, None]] = {
    "png": {"Software": None},
    "pdf": {"Creator": None, "Producer": None, "CreationDate": None},
    "svg": {"Creator": None, "Date": None},
}
"""What Matplotlib writes of itself and of today into each format, left out."""


def write_figures(
    folder: Path,
    result: Any,
    *,
    formats: Sequence[str] = ("png",),
    names: Sequence[str] | None = None,
) -> list[Path]:
    """Draws and writes all figures that a result allows; returns their paths.

    Of all figures those are deleted that an earlier job has left in the folder.

    Args:
        folder: made if it is not there.
        result: a `cfx.results.result.Result`.
        formats: files of each figure: `png`, `pdf`, `svg`.
        names: of the figures; None: all.

    Raises:
        OutputError: a file cannot be written.
    """
    figures = registry.installed("figure")
    if not figures:
        log.warning("No figures are drawn. %s", where_figures_are())
    paths = []
    for figure in figures:
        if names is not None and figure.name not in names:
            continue
        drawing = draw_figure(figure, result)
        for form in ("png", "pdf", "svg"):
            path = folder / f"{figure.name}.{form}"
            if drawing is not None and form in formats:
                paths.append(write_figure(drawing, path))
            elif names is None:
                path.unlink(missing_ok=True)  # of an earlier job in the same folder
    return paths


def write_figure(figure: Figure, path: Path) -> Path:
    """Writes one figure under its final name only once it is complete; returns the path.

    The same figure gives the same bytes: no date and no version of Matplotlib is in it.

    The ending of the path says the format.

    Raises:
        OutputError: the file cannot be written.
    """
    from cfx.figures.canvas import figure_style

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as unfinished, figure_style():
            form = path.suffix.removeprefix(".")
            metadata: Any = FIGURE_METADATA[form]
            figure.savefig(unfinished, format=form, metadata=metadata)
    except OSError as error:
        raise OutputError(
            f"{path}: this figure cannot be written ({error.strerror or error});"
            " free the path or choose another folder"
        ) from error
    return path


def as_html(text: str, table: pd.DataFrame) -> str:
    """Returns a line and the first ten rows of a table as HTML."""
    shown = table.head(10).to_html(float_format=lambda value: f"{value:.3g}", border=0)
    more = f"<p>{len(table) - 10} more rows</p>" if len(table) > 10 else ""
    return f"<p>{html.escape(text)}</p>{shown}{more}"


def for_notebooks(figure: Figure) -> Figure:
    """Returns a figure that notebooks show by themselves; pyplot knows nothing of it."""
    from cfx.figures.canvas import figure_style

    def as_png() -> bytes:
        stream = io.BytesIO()
        with figure_style():
            figure.savefig(stream, format="png")
        return stream.getvalue()

    vars(figure)["_repr_png_"] = as_png
    return figure


def drawn(name: str, result: Any) -> Figure:
    """Returns the figure of a name, in the common look, which notebooks show by themselves.

    Args:
        name: as the figure's files are called.
        result: a `cfx.results.result.Result`.

    Raises:
        DataError: there is no such figure, or the result has nothing of what it shows.
    """
    figure = draw_figure(figure_named(name), result)
    if figure is None:
        raise DataError(f"the job has nothing of what the figure '{name}' shows")
    return for_notebooks(figure)
