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


def write_figures(
    folder: Path,
    evaluation: Evaluation,
    style: StyleResult,
    curves: pd.DataFrame,
    *,
    adapts: bool = True,
    formats: Sequence[str] = ("png",),
) -> list[Path]:
    """Draws and writes all figures of a job; returns their paths.

    Args:
        folder: made if it is not there.
        evaluation: of the job; without a platoon, a history, forecasts or traffic there is no
            `platoon.png`, `history.png`, `forecasts.png` and `forecasts_by_history.png`, or
            `traffic.png` and `traffic_paths.png`; without sampled forecasts no
            `distributions.png`.
        style: of its drivers.
        curves: columns `network`, `epoch`, `train_loss`, `validation_loss`; if it is empty there is
            no `learning_curve.png`.
        adapts: as `Policy.adapts`; if it does not, there is no `improvement_per_driver.png`.
        formats: files of each figure: `png`, `pdf`, `svg`.

    Raises:
        OutputError: a file cannot be written.
    """
    draw: dict[str, Callable[[], Figure]] = {}
    if adapts:
        draw["improvement_per_driver"] = partial(figures.improvements, evaluation)
    draw |= {
        "drives": partial(figures.pairs, evaluation),
        "speeds": partial(figures.speeds, evaluation),
        "error_over_time": partial(figures.errors, evaluation),
        "chosen_parameters": partial(figures.parameters, evaluation),
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
    return _written(draw, folder, formats)


def _written(
    draw: Mapping[str, Callable[[], Figure]], folder: Path, formats: Sequence[str]
) -> list[Path]:
    """Draws and writes figures one after the other, so that only one is in memory."""
    paths = []
    for name, make in draw.items():
        figure = make()
        for form in formats:
            paths.append(write_figure(figure, folder / f"{name}.{form}"))
    return paths


def write_calibration(
    folder: Path,
    evaluation: Evaluation,
    slices: pd.DataFrame,
    fits: pd.DataFrame,
    labels: pd.DataFrame | None,
    *,
    formats: Sequence[str] = ("png",),
) -> list[Path]:
    """Draws and writes what calibration found beyond its parameters; returns their paths.

    Args:
        folder: made if it is not there.
        evaluation: of the job.
        slices: see `cfx.calibration.identifiability.slices`.
        fits: errors of constant parameters on both parts.
        labels: as `Labels.to_frame` returns them; None if there are none.
        formats: as for `write_figures`.

    Raises:
        OutputError: a file cannot be written.
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
    return _written(draw, folder, formats)


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
