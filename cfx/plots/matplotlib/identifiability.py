"""Slices of the loss, fits on both parts, and labels over time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from cfx.calibration.flatness import NEAR
from cfx.plots.choice.identifiability import (
    HIGHEST,
    RATIO_TITLE,
    DriverLabels,
    Fit,
    SlicePanel,
)
from cfx.plots.choice.trajectories import TIME_TITLE, ParameterAxis
from cfx.plots.look import EDGE, INK, colour_of
from cfx.plots.matplotlib.canvas import canvas, styled
from cfx.plots.words import label, number, percent, plural, short, unit_label

_ACROSS = 5
_MARKERS = {"fixed": "o", "population": "D", "default": "|"}


@styled
def draw_slices(panels: Sequence[SlicePanel]) -> Figure:
    """Draws the loss along each parameter: a line per pair, and their median."""
    across = min(_ACROSS, len(panels))
    rows = -(-len(panels) // across)
    figure = canvas(0.9 + 2.3 * rows)
    grid = figure.subplots(rows, across, squeeze=False, sharey=True)
    for place, panel in zip(grid.flat, panels, strict=False):
        place.plot(panel.places, panel.lines.T, color=colour_of("fixed"), alpha=0.15, linewidth=0.8)
        place.plot(panel.places, panel.median, color=INK, linewidth=2)
        place.axhline(1 + NEAR, color=EDGE, linestyle="--", linewidth=1)
        share = percent(panel.near).lstrip("+")
        place.set_title(f"{unit_label(panel.axis.name, panel.axis.unit)}: {share}")
        ends = [number(panel.values[0]), number(panel.values[-1])]
        place.set_xticks([0, 1], ends)
        place.set_ylim(0.97, HIGHEST)
    for unused in grid.flat[len(panels) :]:
        unused.set_visible(False)
    figure.supylabel(RATIO_TITLE, fontsize=10.5, color=INK)
    drivers = plural(len(panels[0].ratios), "pair")
    figure.supxlabel(
        f"one parameter moved from bound to bound, the others held; {drivers} and their median."
        " Percentages: the range on which\na pair's loss is within"
        f" {percent(NEAR).lstrip('+')} of its best (dashed), median over pairs",
        fontsize=10.5,
        color=INK,
    )
    return figure


@styled
def draw_fits(fits: Sequence[Fit]) -> Figure:
    """Draws each pair's error on the part that was calibrated on against that on the test part."""
    figure = canvas(5.2, 6.4)
    axes = figure.subplots()
    highest = 0.0
    for fit in fits:
        highest = max(highest, float(np.quantile(np.concatenate([fit.train, fit.test]), 0.98)))
        medians = f"median {np.median(fit.train):.2f} and {np.median(fit.test):.2f} m/s"
        axes.plot(
            fit.train,
            fit.test,
            linestyle="none",
            marker=_MARKERS[fit.method],
            markersize=4.5 if fit.method == "fixed" else 5.5,
            alpha=0.65,
            color=colour_of(fit.method),
            markerfacecolor=colour_of(fit.method) if fit.method == "fixed" else "none",
            label=f"{label(fit.method)}: {medians}",
            zorder=3 if fit.method == "fixed" else 2,
        )
    end = 1.15 * highest
    axes.plot([0, end], [0, end], color=EDGE, linewidth=1, zorder=1)
    axes.set_xlim(0, end)
    axes.set_ylim(0, end)
    axes.set_aspect("equal")
    axes.set_xlabel("RMSE of speed on the part calibrated on (m/s)")
    axes.set_ylabel("RMSE of speed on the test part (m/s)")
    figure.legend(loc="outside upper center", ncols=1, handlelength=1.0)
    return figure


@styled
def draw_labels(driver: DriverLabels, axes: Sequence[ParameterAxis]) -> Figure:
    """Draws one pair's per-window parameters; pale ones did not matter in their window."""
    shown = [axis for axis in axes if axis.name in driver.values]
    figure = canvas(1.0 + 1.15 * (len(shown) + 1))
    grid = figure.subplots(len(shown) + 1, 1, sharex=True)
    for place, axis in zip(grid, shown, strict=False):
        place.scatter(
            driver.time,
            driver.values[axis.name],
            s=11,
            color=colour_of("policy"),
            alpha=np.maximum(driver.weight, 0.08),
            linewidths=0,
        )
        place.axhline(driver.fixed[axis.name], color=colour_of("fixed"), linewidth=1.6)
        place.set_ylabel(unit_label(axis.name, axis.unit).replace(" ", "\n"), fontsize=9)
        if axis.low is not None and axis.high is not None:
            room = 0.06 * (axis.high - axis.low)
            place.set_ylim(axis.low - room, axis.high + room)
    grid[-1].plot(driver.time, driver.sensitivity, color=INK, linewidth=1.2)
    grid[-1].set_ylabel("sensi-\ntivity", fontsize=9)
    grid[-1].set_ylim(bottom=0)
    grid[-1].set_xlabel(TIME_TITLE)
    figure.suptitle(
        f"{short(driver.pair_id)}: per-window calibrated parameters; the paler, the less the choice"
        " mattered; line: driver-specific",
        fontsize=10.5,
        color=INK,
    )
    return figure
