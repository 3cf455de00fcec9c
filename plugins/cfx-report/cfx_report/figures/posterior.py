"""How well drivers' parameters are known: intervals of all drivers, and one driver's posterior."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from cfx.plugin import (
    INTERVAL_LEVEL,
    MIN_NARROWING,
    JobFigure,
    ParameterAxis,
    Result,
    are_reliable,
    canvas,
    colours,
    wording,
)

_ACROSS = 5

_KINDS = (
    ("determined", "driver_specific", 1.0),
    ("hardly narrower than before the recording", "default", 0.6),
    ("not to be relied on", "population", 1.0),
)
"""Words, whose colour, and opacity of each kind of interval."""

_BEFORE, _AFTER = "before the recording", "after the recording"


def interval_rows(fits: pd.DataFrame) -> pd.DataFrame:
    """Returns the rows of a job's table `fits` that have intervals."""
    if "effective_samples" not in fits:
        return fits.iloc[:0]
    return fits[(fits["method"] == "driver_specific") & fits["effective_samples"].notna()]


@canvas.styled
def draw_intervals(rows: pd.DataFrame, axes: Sequence[ParameterAxis]) -> Figure:
    """Draws each driver's interval of each parameter, in the order of their medians.

    Args:
        rows: as `interval_rows` returns them, at least one.
        axes: the tuned parameters.
    """
    across = min(canvas.most_across(_ACROSS), len(axes))
    down = -(-len(axes) // across)
    figure = canvas.blank(1.1 + 2.4 * down)
    grid = figure.subplots(down, across, squeeze=False)
    for place, axis in zip(grid.flat, axes, strict=False):
        _intervals(place, rows, axis)
    for unused in grid.flat[len(axes) :]:
        unused.set_visible(False)
    handles: dict[str, Artist] = {}
    for place in grid.flat:
        for handle, text in zip(*place.get_legend_handles_labels(), strict=True):
            handles.setdefault(text, handle)
    in_order = [handles[words] for words, _, _ in _KINDS if words in handles]
    canvas.legend_above(figure, in_order)
    figure.supxlabel(
        canvas.wrapped(
            f"{wording.plural(len(rows), 'pair')}, in the order of their medians (dots); above each"
            " panel: for how many the parameter is determined"
        ),
        fontsize=canvas.points(10.5),
        color=colours.INK,
    )
    return figure


def _intervals(place: Axes, rows: pd.DataFrame, axis: ParameterAxis) -> None:
    ordered = rows.sort_values(f"median_{axis.name}")
    number = np.arange(len(ordered))
    reliable = are_reliable(ordered).to_numpy(dtype=bool)
    determined = ordered[f"contraction_{axis.name}"].to_numpy(dtype=float) >= MIN_NARROWING
    kinds = (reliable & determined, reliable & ~determined, ~reliable)
    columns = [f"low_{axis.name}", f"median_{axis.name}", f"high_{axis.name}"]
    low, middle, high = ordered[columns].to_numpy(dtype=float).T
    size = max(0.8, min(3.0, 120.0 / len(ordered)))
    for is_of_kind, (words, method, opacity) in zip(kinds, _KINDS, strict=True):
        if is_of_kind.any():
            place.vlines(
                number[is_of_kind],
                low[is_of_kind],
                high[is_of_kind],
                color=colours.colour_of(method),
                alpha=opacity,
                linewidth=size,
                label=words,
            )
    # White around a dot tells it from the interval that it lies on.
    place.plot(
        number,
        middle,
        "o",
        color=colours.INK,
        markersize=1.4 * size,
        markeredgecolor="white",
        markeredgewidth=0.3 * size,
    )
    if axis.low is not None and axis.high is not None:
        for bound in (axis.low, axis.high):
            place.axhline(bound, color=colours.EDGE, linestyle="--", linewidth=1)
    place.set_xticks([])
    count = int((reliable & determined).sum())
    place.set_title(f"{wording.unit_label(axis.name, axis.unit)}: {count} of {len(ordered)}")


@canvas.styled
def draw_pairs(
    pair_id: str,
    draws: pd.DataFrame,
    axes: Sequence[ParameterAxis],
    prior: pd.DataFrame | None = None,
) -> Figure:
    """Draws a driver's draws of each two parameters, within the bounds.

    Args:
        pair_id: of the driver's pair.
        draws: a row per draw, with a column `parameter_NAME` for each parameter.
        axes: the tuned parameters.
        prior: the same before the recording is seen.
    """
    count = len(axes)
    figure = canvas.blank(1.0 + 1.15 * count, 2.0 + 1.3 * count)
    grid = figure.subplots(count, count, squeeze=False)
    for row, vertical in enumerate(axes):
        for column, horizontal in enumerate(axes):
            place = grid[row, column]
            if column > row:
                place.set_visible(False)
                continue
            _limits(place.set_xlim, horizontal)
            if column == row:
                _densities(place, draws, prior, horizontal)
            else:
                if prior is not None:
                    _scatter(place, prior.head(len(draws)), horizontal, vertical, "default")
                _scatter(place, draws, horizontal, vertical, "driver_specific")
                _limits(place.set_ylim, vertical)
                place.yaxis.set_major_locator(MaxNLocator(3))
            place.xaxis.set_major_locator(MaxNLocator(3))
            place.tick_params(labelsize=canvas.points(8))
            place.label_outer()
    for number, axis in enumerate(axes):
        named = wording.unit_label(axis.name, axis.unit)
        grid[-1, number].set_xlabel(named, fontsize=canvas.points(9))
        grid[number, 0].set_ylabel(named if number else "density", fontsize=canvas.points(9))
    handles, _ = grid[0, 0].get_legend_handles_labels()
    canvas.legend_above(figure, handles)
    caption = canvas.wrapped(
        f"{wording.shortened(pair_id)}: {wording.plural(len(draws), 'draw')} from the posterior"
    )
    figure.supxlabel(caption, fontsize=canvas.points(10.5), color=colours.INK)
    return figure


def _scatter(
    place: Axes, rows: pd.DataFrame, horizontal: ParameterAxis, vertical: ParameterAxis, method: str
) -> None:
    across = rows[f"parameter_{horizontal.name}"].to_numpy(dtype=float)
    along = rows[f"parameter_{vertical.name}"].to_numpy(dtype=float)
    place.plot(across, along, ".", color=colours.colour_of(method), alpha=0.4, markersize=2.5)


def _densities(
    place: Axes, draws: pd.DataFrame, prior: pd.DataFrame | None, axis: ParameterAxis
) -> None:
    """Draws how likely values of one parameter are, before and after the recording."""
    name = f"parameter_{axis.name}"
    both = draws[name] if prior is None else pd.concat([draws[name], prior[name]])
    edges = np.histogram_bin_edges(both.to_numpy(dtype=float), bins=30).tolist()
    place.hist(
        draws[name],
        bins=edges,
        density=True,
        color=colours.colour_of("driver_specific"),
        label=_AFTER,
    )
    if prior is not None:
        colour = colours.colour_of("default")
        place.hist(
            prior[name], bins=edges, density=True, histtype="step", color=colour, label=_BEFORE
        )
    place.set_yticks([])


@canvas.styled
def draw_fan(pair_id: str, rows: pd.DataFrame) -> Figure:
    """Draws the fan of a driver's trajectories, and what was recorded.

    Args:
        pair_id: of the driver's pair.
        rows: of the table `fan`.
    """
    figure = canvas.blank(3.6)
    place = figure.subplots()
    time = rows["time_s"].to_numpy(dtype=float)
    columns = ["low", "median", "high", "measured"]
    low, middle, high, measured = rows[columns].to_numpy(dtype=float).T
    colour = colours.colour_of("driver_specific")
    place.fill_between(
        time,
        low,
        high,
        color=colour,
        alpha=0.3,
        linewidth=0,
        label=f"{INTERVAL_LEVEL:.0%} of trajectories",
    )
    place.plot(time, middle, color=colour, label="median")
    place.plot(time, measured, color=colours.INK, label="recorded")
    held_out = ~rows["calibrated_on"].to_numpy(dtype=bool)
    caption = wording.shortened(pair_id)
    if held_out.any():
        is_inside = (low <= measured) & (measured <= high)
        place.axvline(time[held_out][0], color=colours.EDGE, linestyle="--", linewidth=1)
        caption += (
            ": without noise up to the dashed line; after it forecasts with noise, which hold"
            f" {is_inside[held_out].mean():.0%} of the recording"
        )
    place.set_xlabel("time from the start of the pair (s)")
    signal = str(rows["signal"].iloc[0])
    place.set_ylabel(wording.unit_label(signal, {"speed": "m/s", "gap": "m"}[signal]))
    handles, _ = place.get_legend_handles_labels()
    canvas.legend_above(figure, handles)
    figure.supxlabel(canvas.wrapped(caption), fontsize=canvas.points(10.5), color=colours.INK)
    return figure


def _limits(limit: object, axis: ParameterAxis) -> None:
    if axis.low is not None and axis.high is not None and callable(limit):
        limit(axis.low, axis.high)


def _middle(rows: pd.DataFrame) -> str:
    """Returns the pair whose parameters are known as well as those of half of the pairs."""
    contraction = rows.filter(regex="^contraction_").mean(axis=1)
    order = contraction.sort_values().index
    return str(rows.loc[order[len(order) // 2], "pair_id"])


class PosteriorIntervals(JobFigure):
    """Intervals of each parameter of all drivers."""

    title = f"{INTERVAL_LEVEL:.0%} intervals of each driver's parameters"
    caption = (
        f"What each recording says of its driver's parameters: {INTERVAL_LEVEL:.0%} intervals"
        " between the bounds (dashed). Above each panel: for how many pairs the recording"
        " determines the parameter, so that the interval is at least"
        f" {MIN_NARROWING:.0%} narrower than before."
    )
    order = 133

    def draw(self, result: Result) -> Figure | None:
        """Draws it where the job has a posterior."""
        fits = result.tables.get("fits")
        if fits is None:
            return None
        rows = interval_rows(fits)
        axes = [axis for axis in result.parameters if f"median_{axis.name}" in rows]
        return draw_intervals(rows, axes) if len(rows) and axes else None


class PosteriorPairs(JobFigure):
    """One driver's posterior of each two parameters."""

    title = "The posterior of one driver's parameters"
    caption = (
        "Draws from the posterior of the pair whose parameters are known about as well as those of"
        " half of the pairs, and what was likely before the recording. A narrow diagonal band: the"
        " recording determines a combination of both parameters, but not each. Where both look"
        " alike, it says nothing."
    )
    order = 134

    def draw(self, result: Result) -> Figure | None:
        """Draws it where the job has a posterior."""
        fits, draws = result.tables.get("fits"), result.tables.get("posterior")
        if fits is None or draws is None or interval_rows(fits).empty:
            return None
        pair_id = _middle(interval_rows(fits))
        of_pair = draws[draws["pair_id"].astype(str) == pair_id]
        axes = [axis for axis in result.parameters if f"parameter_{axis.name}" in of_pair]
        prior = result.tables.get("population", result.tables.get("prior"))
        return draw_pairs(pair_id, of_pair, axes, prior) if len(of_pair) and axes else None


class PosteriorFan(JobFigure):
    """What one driver's posterior says of their trajectory."""

    title = "Trajectories of one driver's posterior"
    caption = (
        f"The middle {INTERVAL_LEVEL:.0%} of the trajectories of the same driver's posterior, and"
        " what was recorded. Up to the dashed line, on the part that was calibrated on, they are"
        " predictions without noise: one closed loop or, where noise is of the driver's"
        " acceleration, from measured state to measured state. So the recording may lie outside."
        " After it they are forecasts, with noise that goes on from the last error."
    )
    order = 135

    def draw(self, result: Result) -> Figure | None:
        """Draws it where the job has a posterior."""
        fits, fan = result.tables.get("fits"), result.tables.get("fan")
        if fits is None or fan is None or interval_rows(fits).empty:
            return None
        pair_id = _middle(interval_rows(fits))
        of_pair = fan[fan["pair_id"].astype(str) == pair_id]
        return draw_fan(pair_id, of_pair) if len(of_pair) else None
