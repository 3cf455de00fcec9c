"""Write figures as files of a job's folder, and for notebooks."""

from __future__ import annotations

import html
import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from cfx.core import registry
from cfx.core.errors import DataError, OutputError
from cfx.core.files import atomic_write
from cfx.figures.canvas import figure_style
from cfx.figures.figure import Results, draw, figure_named

if TYPE_CHECKING:
    import pandas as pd

METADATA: dict[str, dict[str, None]] = {
    "png": {"Software": None},
    "pdf": {"Creator": None, "Producer": None, "CreationDate": None},
    "svg": {"Creator": None, "Date": None},
}
"""What Matplotlib writes of itself and of today into each format, left out."""


def write_figures(
    folder: Path,
    results: Results,
    *,
    formats: Sequence[str] = ("png",),
    names: Sequence[str] | None = None,
) -> list[Path]:
    """Draws and writes all figures that the results allow; returns their paths.

    Of all figures those are deleted that an earlier job has left in the folder.

    Args:
        folder: made if it is not there.
        results: of a job.
        formats: files of each figure: `png`, `pdf`, `svg`.
        names: of the figures; None: all.

    Raises:
        OutputError: a file cannot be written.
    """
    paths = []
    for one in registry.installed("figure"):
        if names is not None and one.name not in names:
            continue
        figure = draw(one, results)
        for form in ("png", "pdf", "svg"):
            path = folder / f"{one.name}.{form}"
            if figure is not None and form in formats:
                paths.append(write_figure(figure, path))
            elif names is None:
                path.unlink(missing_ok=True)  # of an earlier job in the same folder
    return paths


def write_figure(figure: Figure, path: Path) -> Path:
    """Writes one figure under its final name only once it is complete; returns the path.

    The same figure gives the same bytes: no date and no version of Matplotlib is in it.

    Args:
        figure: what is drawn.
        path: its ending says the format.

    Raises:
        OutputError: the file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as unfinished, figure_style():
            _print(figure, unfinished, path.suffix.removeprefix("."))
    except OSError as error:
        raise OutputError(
            f"{path}: this figure cannot be written ({error.strerror or error});"
            " free the path or choose another folder"
        ) from error
    return path


def _print(figure: Figure, path: Path, form: str) -> None:
    """Draws a figure into a file; `savefig` would draw twice, once for the layout alone."""
    metadata: Any = METADATA[form]
    paper: Any
    if form == "png":
        paper = FigureCanvasAgg(figure)
        paper.print_png(path, metadata=metadata)
    elif form == "pdf":
        # Imported where it is used: it takes as long as a few figures.
        from matplotlib.backends.backend_pdf import FigureCanvasPdf

        paper = FigureCanvasPdf(figure)
        paper.print_pdf(path, metadata=metadata)
    else:
        paper = FigureCanvasSVG(figure)
        paper.print_svg(path, metadata=metadata)


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


def drawn(name: str, results: Results) -> Figure:
    """Return the figure of a name, in the common look, which notebooks show by themselves.

    Raises:
        DataError: there is no such figure, or the results have nothing of what it shows.
    """
    figure = draw(figure_named(name), results)
    if figure is None:
        raise DataError(f"the job has nothing of what the figure '{name}' shows")
    return for_notebooks(figure)
