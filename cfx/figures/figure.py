"""What a figure of a job is: what it shows of the results, how it is drawn and written.

An entry point of the group `cfx.figures` makes it known; its name becomes that of the figure's
files.
"""

from __future__ import annotations

import html
import io
from abc import abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import pandas as pd

from cfx.core import registry
from cfx.core.component import Component
from cfx.core.distributions import install_line
from cfx.core.files import atomic_write
from cfx.errors import DataError, OutputError, listed, nearest
from cfx.evaluation.result import Purpose
from cfx.simulation.trajectory import TRANSIENT_S

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from cfx.core.parameters import Parameter
    from cfx.data.style import StyleResult
    from cfx.evaluation.result import Evaluation, PairTrajectory
    from cfx.evaluation.statistics import Improvement


@dataclass(frozen=True)
class ParameterAxis:
    """A tuned parameter: name, unit, bounds within which policies choose, and what it is."""

    name: str
    unit: str = ""
    low: float | None = None
    high: float | None = None
    meaning: str = ""


def parameter_axes(parameters: Iterable[Parameter]) -> tuple[ParameterAxis, ...]:
    """Returns what figures show of a model's parameters."""
    axes = []
    for one in parameters:
        axes.append(ParameterAxis(one.name, one.unit, one.low, one.high, one.meaning))
    return tuple(axes)


@dataclass(frozen=True)
class Results:
    """What a finished job has measured; a running job and a report make it, each of what it has.

    Attributes:
        pairs: a row per pair and method, as in `pairs.csv`.
        methods: those that are shown, in their order; without the policy if it does not adapt.
        parameters: the tuned ones.
        trajectories: test parts of all pairs; empty if none are known.
        improvements: of the policy by baseline; empty where that is not the job's purpose.
        style: of the drivers; None if it is not known. Without weights these are not known.
        tables: what the job has written, by name (`cfx.results.table`): of `curves`, `platoon`,
            `history`, `forecasts`, `slices`, `fits`, `labels` and those of plugins, what there is.
        metrics: of the job, under their names in `metrics.json`.
        transient_s: length of the transient at the beginning of the test part, s.
    """

    pairs: pd.DataFrame
    methods: tuple[str, ...]
    parameters: tuple[ParameterAxis, ...]
    trajectories: Sequence[PairTrajectory] = ()
    improvements: Mapping[str, Improvement] = field(default_factory=dict)
    style: StyleResult | None = None
    tables: Mapping[str, pd.DataFrame] = field(default_factory=dict)
    metrics: Mapping[str, float] = field(default_factory=dict)
    transient_s: float = TRANSIENT_S

    @classmethod
    def of(
        cls,
        evaluation: Evaluation,
        *,
        style: StyleResult | None = None,
        tables: Mapping[str, pd.DataFrame] | None = None,
        metrics: Mapping[str, float] | None = None,
    ) -> Results:
        """Returns the results of an evaluation; the rest as in the attributes.

        Without `metrics` they are those of the evaluation alone.
        """
        shown = evaluation.distinct_methods()
        improvements: Mapping[str, Improvement] = {}
        if evaluation.purpose is Purpose.ADAPTATION:
            improvements = evaluation.improvements["test"]
        return cls(
            pairs=shown.table,
            methods=shown.methods,
            parameters=parameter_axes(evaluation.parameters),
            trajectories=evaluation.trajectories,
            improvements=improvements,
            style=style,
            tables=tables or {},
            metrics=evaluation.metrics() if metrics is None else metrics,
        )


class JobFigure(Component):
    """A figure of a finished job, the same in its folder and in reports.

    Attributes:
        title: what it shows, in a few words, for readers who do not see it too.
        caption: sentences that a reader needs to read it.
        order: its place among the figures of a job; smaller numbers come first.
    """

    kind = "figure"
    title: ClassVar[str] = ""
    caption: ClassVar[str] = ""
    order: ClassVar[int] = 1000

    @classmethod
    def complaint(cls) -> str:
        """Returns what is wrong with what a class declares; "" if nothing is."""
        return "" if cls.title and cls.caption else " has no title or no caption; give it both"

    @abstractmethod
    def draw(self, results: Results) -> Figure | None:
        """Draws it, with `cfx.figures.canvas.canvas` as its paper.

        It is called in the common look. A figure belongs to no window (`pyplot` is not used) and
        the same results give the same figure.

        Returns:
            None where the results hold nothing of what it shows.
        """


def where_figures_are() -> str:
    """Return how figures of jobs are installed."""
    return f"Figures of jobs come with cfx-report: {install_line('cfx-report')}"


def figure_named(name: str) -> registry.Installed[JobFigure]:
    """Return the figure of a name.

    Raises:
        DataError: there is none that works.
    """
    known = {one.name: one for one in registry.installed("figure")}
    if name in known:
        return known[name]
    others = f"{nearest(name, known)} Known: {listed(list(known))}."
    message = f"there is no figure '{name}'."
    raise DataError(message + (others if known else f" {where_figures_are()}"))


def draw_figure(one: registry.Installed[JobFigure], results: Results) -> Figure | None:
    """Return a figure in the common look; None where there is nothing to show, or it fails."""
    from cfx.figures.canvas import figure_style

    def attempt(figure: JobFigure) -> Figure | None:
        with figure_style():
            return figure.draw(results)

    return one.attempt(attempt, None)


FIGURE_METADATA: dict[str, dict[str, None]] = {
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
        formats: files of each figure: `png`, `pdf`, `svg`.
        names: of the figures; None: all.

    Raises:
        OutputError: a file cannot be written.
    """
    paths = []
    for one in registry.installed("figure"):
        if names is not None and one.name not in names:
            continue
        figure = draw_figure(one, results)
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


def drawn(name: str, results: Results) -> Figure:
    """Return the figure of a name, in the common look, which notebooks show by themselves.

    Raises:
        DataError: there is no such figure, or the results have nothing of what it shows.
    """
    figure = draw_figure(figure_named(name), results)
    if figure is None:
        raise DataError(f"the job has nothing of what the figure '{name}' shows")
    return for_notebooks(figure)
