"""How a job's figures are found, drawn in the common look, and written.

The result of which a figure is drawn is passed on as it is: only figures look into it.
"""

from __future__ import annotations

import html
import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from cfx.core import registry
from cfx.core.distributions import advice
from cfx.core.files import atomic_write
from cfx.errors import DataError, OutputError

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


def figure_named(name: str) -> registry.Installed[Any]:
    """Returns the figure of a name.

    Raises:
        DataError: there is none that works.
    """
    figures = {figure.name: figure for figure in registry.installed("figure")}
    if name in figures:
        return figures[name]
    raise DataError(f"there is no figure '{name}'.{advice('figure', name, list(figures))}")


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
    figures: Iterable[registry.Installed[Any]] | None = None,
    *,
    formats: Sequence[str] = ("png",),
) -> list[Path]:
    """Draws and writes figures, those that a result allows; returns their paths.

    Args:
        folder: made if it is not there.
        result: a `cfx.results.result.Result`.
        figures: to be drawn; None: all that are installed.
        formats: files of each figure: `png`, `pdf`, `svg`.

    Raises:
        OutputError: a file cannot be written.
    """
    paths = []
    for figure in registry.installed("figure") if figures is None else figures:
        drawing = draw_figure(figure, result)
        if drawing is None:
            continue
        for form in FIGURE_METADATA:
            if form in formats:
                paths.append(write_figure(drawing, folder / f"{figure.name}.{form}"))
    return paths


def remove_figures(folder: Path) -> None:
    """Removes the figures that an earlier job has left in a folder; other files stay.

    Raises:
        OSError: a file cannot be removed.
    """
    for figure in registry.installed("figure"):
        for form in FIGURE_METADATA:
            (folder / f"{figure.name}.{form}").unlink(missing_ok=True)


def write_figure(figure: Figure, path: Path) -> Path:
    """Writes one figure under its final name only once it is complete; returns the path.

    The same figure gives the same bytes: no date and no version of Matplotlib is in it.

    The ending of the path says the format.

    Raises:
        OutputError: the file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as unfinished:
            _print(figure, unfinished, path.suffix.removeprefix("."))
    except OSError as error:
        raise OutputError(
            f"{path}: this figure cannot be written ({error.strerror or error});"
            " free the path or choose another folder"
        ) from error
    return path


def _print(figure: Figure, to: Path | io.BytesIO, form: str) -> None:
    """Writes a figure in one of the formats of `FIGURE_METADATA`."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    from cfx.figures.canvas import figure_style

    metadata: Any = FIGURE_METADATA[form]
    with figure_style():
        if form == "png":
            # `savefig` writes the same bytes, but draws twice, once for the layout alone.
            canvas: Any = FigureCanvasAgg(figure)  # Matplotlib does not type print_png
            canvas.print_png(to, metadata=metadata)
        else:
            figure.savefig(to, format=form, metadata=metadata)


def as_html(text: str, table: pd.DataFrame) -> str:
    """Returns a line and the first ten rows of a table as HTML."""
    shown = table.head(10).to_html(float_format=lambda value: f"{value:.3g}", border=0)
    more = f"<p>{len(table) - 10} more rows</p>" if len(table) > 10 else ""
    return f"<p>{html.escape(text)}</p>{shown}{more}"


def for_notebooks(figure: Figure) -> Figure:
    """Returns a figure that notebooks show by themselves; pyplot knows nothing of it."""

    def as_png() -> bytes:
        stream = io.BytesIO()
        _print(figure, stream, "png")
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
