"""Writes a job's figures."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from cfx.errors import OutputError
from cfx.evaluation.result import Evaluation
from cfx.figures.drives import chosen_parameters, drives, speeds
from cfx.figures.history import history_gain
from cfx.figures.improvement import improvement_per_driver
from cfx.figures.learning import learning_curve
from cfx.figures.look import DPI, look
from cfx.figures.platoon import platoons
from cfx.figures.start import error_over_time
from cfx.figures.style import style_distribution
from cfx.files import atomic_write
from cfx.style.result import StyleResult


def write_figures(
    folder: Path, evaluation: Evaluation, style: StyleResult, curves: pd.DataFrame
) -> list[Path]:
    """Draws and writes all figures of a job as PNG; returns their paths.

    Args:
        folder: made if it is not there.
        curves: columns `network`, `epoch`, `train_loss`, `validation_loss`; empty if nothing was learned, and then there is no
            `learning_curve.png`. Neither is there a `platoon.png` or `history.png` where the protocol delivered no such result.

    Raises:
        OutputError: a file cannot be written.
    """
    jobs: dict[str, Callable[[], Figure]] = {
        "improvement_per_driver": lambda: improvement_per_driver(evaluation),
        "drives": lambda: drives(evaluation),
        "speeds": lambda: speeds(evaluation),
        "error_over_time": lambda: error_over_time(evaluation),
        "chosen_parameters": lambda: chosen_parameters(evaluation),
        "style_distribution": lambda: style_distribution(style),
    }
    if len(curves):
        jobs["learning_curve"] = lambda: learning_curve(curves)
    platoon, history = evaluation.platoon, evaluation.history
    if platoon is not None:
        jobs["platoon"] = lambda: platoons(platoon)
    if history is not None:
        jobs["history"] = lambda: history_gain(history)
    return [write_figure(draw(), folder / f"{name}.png") for name, draw in jobs.items()]


def write_figure(figure: Figure, path: Path) -> Path:
    """Writes one figure under its final name only once it is complete; returns the path.

    Raises:
        OutputError: the file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as partial, look(), warnings.catch_warnings():
            # A name in a script that the font lacks shows boxes; the names themselves are in pairs.csv.
            warnings.filterwarnings("ignore", message="Glyph .* missing from", category=UserWarning)
            figure.savefig(partial, format="png", dpi=DPI, metadata={"Software": None})
    except OSError as error:
        raise OutputError(
            f"{path}: this figure cannot be written ({error.strerror or error}); free the path or choose another folder"
        ) from error
    return path
