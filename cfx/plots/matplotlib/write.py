"""Writes a job's figures."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from cfx.errors import OutputError
from cfx.evaluation.result import Evaluation
from cfx.files import atomic_write
from cfx.plots.choice.identifiability import fits_of, labels_of, slice_panels
from cfx.plots.choice.trajectories import parameter_axes
from cfx.plots.matplotlib import figures
from cfx.plots.matplotlib.canvas import DPI, look
from cfx.plots.matplotlib.identifiability import draw_fits, draw_labels, draw_slices
from cfx.style.result import StyleResult

_METADATA: dict[str, dict[str, None]] = {
    "png": {"Software": None},
    "pdf": {"Creator": None, "Producer": None, "CreationDate": None},
    "svg": {"Creator": None, "Date": None},
}
"""What Matplotlib writes of itself and of today into each format, left out."""


Figures = Mapping[str, Callable[[], Figure]]
"""What draws each figure, by the name of its files."""


def figures_of_job(
    evaluation: Evaluation, style: StyleResult, curves: pd.DataFrame, *, adapts: bool = True
) -> Figures:
    """Returns what draws the figures of a job.

    Args:
        evaluation: of the job; without a platoon, a history, forecasts or traffic there is no
            `platoon`, `history`, `forecasts` and `forecasts_by_history`, or `traffic` and
            `traffic_paths`; without sampled forecasts no `distributions`.
        style: of its drivers.
        curves: columns `network`, `epoch`, `train_loss`, `validation_loss`; if it is empty there is
            no `learning_curve`.
        adapts: as `Policy.adapts`; if it does not, there is no `improvement_per_driver`, and the
            policy is no method of its own.
    """
    draw: dict[str, Callable[[], Figure]] = {}
    shown = evaluation if adapts else evaluation.constant_methods()
    if adapts:
        draw["improvement_per_driver"] = partial(figures.improvements, evaluation)
    draw |= {
        "drives": partial(figures.pairs, shown),
        "speeds": partial(figures.speeds, shown),
        "error_over_time": partial(figures.errors, shown),
        "chosen_parameters": partial(figures.parameters, shown),
        "style_distribution": partial(figures.style, style),
    }
    if "fixed" in evaluation.methods and evaluation.names:
        draw["calibration"] = partial(figures.calibration, evaluation)
    if len(curves):
        draw["learning_curve"] = partial(figures.learning, curves)
    if evaluation.platoon is not None:
        draw["platoon"] = partial(figures.platoons, evaluation.platoon)
    if evaluation.history is not None:
        draw["history"] = partial(figures.history, evaluation.history)
    if evaluation.forecasts is not None:
        draw["forecasts"] = partial(figures.forecasts, evaluation.forecasts)
        if evaluation.forecasts.varies_history:
            draw["forecasts_by_history"] = partial(
                figures.forecasts_by_history, evaluation.forecasts
            )
        if evaluation.forecasts.distributions is not None:
            draw["distributions"] = partial(figures.distributions, evaluation.forecasts)
    if evaluation.traffic is not None:
        draw["traffic"] = partial(figures.traffic, evaluation.traffic)
        draw["traffic_paths"] = partial(figures.traffic_paths, evaluation.traffic)
    return draw


def figures_of_calibration(
    evaluation: Evaluation, slices: pd.DataFrame, fits: pd.DataFrame, labels: pd.DataFrame | None
) -> Figures:
    """Returns what draws what calibration found beyond its parameters.

    Args:
        evaluation: of the job.
        slices: see `cfx.calibration.identifiability.slices`.
        fits: errors of constant parameters on both parts.
        labels: as `Labels.to_frame` returns them; None if there are none.
    """
    axes = parameter_axes(evaluation)
    draw: dict[str, Callable[[], Figure]] = {}
    panels = slice_panels(slices, axes)
    if panels:
        draw["identifiability"] = partial(draw_slices, panels)
    found = fits_of(fits)
    if found:
        draw["fit_train_test"] = partial(draw_fits, found)
    if labels is not None:
        drivers = labels_of(labels, evaluation.table, axes)
        if drivers:
            draw["labels_over_time"] = partial(draw_labels, drivers[len(drivers) // 2], axes)
    return draw


def write_figures(folder: Path, draw: Figures, *, formats: Sequence[str] = ("png",)) -> list[Path]:
    """Draws and writes figures, one after the other; returns their paths.

    Args:
        folder: made if it is not there.
        draw: which figures.
        formats: files of each figure: `png`, `pdf`, `svg`.

    Raises:
        OutputError: a file cannot be written.
    """
    paths = []
    for name, make in draw.items():
        figure = make()
        for form in formats:
            paths.append(write_figure(figure, folder / f"{name}.{form}"))
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
        with atomic_write(path) as unfinished, look(), warnings.catch_warnings():
            # A name in a script that the font lacks shows boxes; the names are in pairs.csv.
            warnings.filterwarnings("ignore", message="Glyph .* missing from", category=UserWarning)
            form = path.suffix.removeprefix(".")
            figure.savefig(unfinished, format=form, dpi=DPI, metadata=_METADATA[form])
    except OSError as error:
        raise OutputError(
            f"{path}: this figure cannot be written ({error.strerror or error});"
            " free the path or choose another folder"
        ) from error
    return path
