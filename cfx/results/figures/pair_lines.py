"""Pairs over time, best to worst: speed, gap and the parameters of each method."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.gridspec import GridSpec
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from cfx.errors import ConfigError, nearest
from cfx.figures import canvas, colours, wording
from cfx.results.figure import JobFigure
from cfx.results.figures.improvement_bars import improvement_title

if TYPE_CHECKING:
    from cfx.evaluation.result import PairTrajectory
    from cfx.results.result import ParameterAxis, Result

__all__ = [
    "TIME_TITLE",
    "RankedPair",
    "chosen_pairs",
    "draw_pair",
    "drives",
    "evenly_spread",
    "rank_pairs",
]
"""What plugins may use, as `cfx.plugin.pair_lines`."""


TIME_TITLE = "time from the start of the pair (s)"

_ROOM = 1.5
"""The default may stretch an axis by so many times the range of the other lines, on either side."""


@dataclass(frozen=True)
class Panel:
    """Lines on common axes.

    Attributes:
        title: what is shown, with its unit.
        lines: those that are drawn, the hidden ones too.
        low, high: ends of the vertical axis; None where nothing is known of them.
        notes: remarks on the default, each at the upper end (true) or the lower end of the panel.
        collisions: method, time (s) and gap (m) where a simulated gap first becomes negative.
        bounds: of a parameter, if they are known.
        meaning: of a parameter, in words.
    """

    title: str
    lines: tuple[canvas.Line, ...]
    low: float | None
    high: float | None
    notes: tuple[tuple[str, bool], ...] = ()
    collisions: tuple[tuple[str, float, float], ...] = ()
    bounds: tuple[float, float] | None = None
    meaning: str = ""


@dataclass(frozen=True)
class PairPanels:
    """What is shown of one pair.

    Attributes:
        pair_id: which pair.
        speed, gap: over the test part.
        parameters: a panel for each tuned parameter.
    """

    pair_id: str
    speed: Panel
    gap: Panel
    parameters: tuple[Panel, ...]


def pair_panels(
    trajectory: PairTrajectory, methods: Sequence[str], parameters: Sequence[ParameterAxis]
) -> PairPanels:
    """Chooses the panels of one pair.

    Args:
        trajectory: the pair.
        methods: those to show, in their order; what a trajectory lacks is left out.
        parameters: in the order in which the trajectory has them.
    """
    time = trajectory.time
    present = [method for method in methods if method in trajectory.speed]
    speed_lines = [canvas.Line("leader", time, trajectory.leader_speed)]
    speed_lines += _lines(time, trajectory.real_speed, trajectory.speed, present)
    gap_lines = _lines(time, trajectory.real_gap, trajectory.gap, present)
    panels = []
    for k, parameter in enumerate(parameters):
        lines = []
        for method in present:
            lines.append(canvas.Line(method, time, trajectory.parameters[method][:, k], steps=True))
        panels.append(_parameter_panel(parameter, tuple(lines)))
    return PairPanels(
        trajectory.pair_id,
        _signal_panel("speed", "m/s", tuple(speed_lines)),
        _signal_panel("gap", "m", tuple(gap_lines), _collisions(gap_lines)),
        tuple(panels),
    )


def _lines(
    time: canvas.Array,
    real: canvas.Array,
    simulated: Mapping[str, canvas.Array],
    methods: Sequence[str],
) -> list[canvas.Line]:
    lines = [canvas.Line("real", time, real)]
    for method in methods:
        lines.append(canvas.Line(method, time, simulated[method]))
    return lines


def _signal_panel(
    name: str,
    unit: str,
    lines: tuple[canvas.Line, ...],
    collisions: tuple[tuple[str, float, float], ...] = (),
) -> Panel:
    """Chooses the axis by the lines that matter; a note says how far a default lies off them."""
    defaults, others = [], []
    for line in lines:
        if line.method == "default":
            defaults.append(line)
        else:
            others.append(line)
    low, high = _range(others)
    notes: list[tuple[str, bool]] = []
    if low is not None and high is not None:
        # At least 1 m/s or 1 m, so that rounding does not fill the panel of a steady pair.
        height = max(high - low, 1.0)
        lowest, highest = low - _ROOM * height, high + _ROOM * height
        default_low, default_high = _range(defaults)
        if default_low is not None and default_high is not None:
            if default_high > highest:
                notes.append((f"default up to {wording.number_text(default_high)} {unit} ↑", True))
            if default_low < lowest:
                text = f"default down to {wording.number_text(default_low)} {unit} ↓"
                notes.append((text, False))
            low = min(low, max(default_low, lowest))
            high = max(high, min(default_high, highest))
        low, high = low - 0.06 * height, high + 0.06 * height
    title = wording.unit_label(name, unit)
    return Panel(title, lines, low, high, tuple(notes), collisions)


def _range(lines: Sequence[canvas.Line]) -> tuple[float | None, float | None]:
    """Returns the lowest and the highest value of the lines that are not hidden; None for none."""
    visible = [np.empty(0)]
    for line in lines:
        if not line.hidden:
            visible.append(line.values)
    values = canvas.finite(np.concatenate(visible))
    if not len(values):
        return None, None
    return float(values.min()), float(values.max())


def _collisions(lines: Sequence[canvas.Line]) -> tuple[tuple[str, float, float], ...]:
    collisions = []
    for line in lines:
        hit = np.flatnonzero(line.values < 0)
        if line.method != "real" and not line.hidden and len(hit):
            first = int(hit[0])
            collisions.append((line.method, float(line.time[first]), float(line.values[first])))
    return tuple(collisions)


def _parameter_panel(parameter: ParameterAxis, lines: tuple[canvas.Line, ...]) -> Panel:
    """Chooses an axis of at least a fifth of the range: a small change looks small."""
    title, meaning = wording.unit_label(parameter.name, parameter.unit), parameter.meaning
    lowest, highest = _range(lines)
    if parameter.low is None or parameter.high is None:
        if lowest is None or highest is None:
            return Panel(title, lines, None, None, meaning=meaning)
        margin = 0.15 * max(highest - lowest, 1e-3 * abs(highest), 1e-6)
        return Panel(title, lines, lowest - margin, highest + margin, meaning=meaning)
    bounds = (parameter.low, parameter.high)
    if lowest is None or highest is None:
        lowest, highest = bounds
    width = max(1.3 * (highest - lowest), 0.2 * (bounds[1] - bounds[0]))
    centre, margin = (highest + lowest) / 2, 0.06 * width
    low = max(centre - width / 2, min(bounds[0], lowest)) - margin
    high = min(centre + width / 2, max(bounds[1], highest)) + margin
    return Panel(title, lines, low, high, bounds=bounds, meaning=meaning)


_LINE = 150
"""Characters of a small title that fit into the width of a figure."""


@canvas.styled
def draw_pairs(
    titles: Sequence[tuple[str, str, str]],
    pairs: Sequence[PairPanels],
    methods: Sequence[str],
    explained: str | None = None,
) -> Figure:
    """Draws speed and gap of some pairs over the test part, a row per pair.

    Args:
        titles: of each pair: its own, that of its speeds, that of its gaps.
        pairs: what is shown.
        methods: for the legend.
        explained: what percentages in the titles mean; stands above the legend.
    """
    figure = canvas.blank(0.75 + 2.35 * len(pairs))
    grid = _rows_of_two(figure, len(pairs))
    for (speed_axes, gap_axes), pair, title in zip(grid, pairs, titles, strict=True):
        draw_panel(speed_axes, pair.speed)
        draw_panel(gap_axes, pair.gap)
        _two_line_title(speed_axes, title[0], title[1])
        _two_line_title(gap_axes, "", title[2])
    for axes in grid[-1]:
        axes.set_xlabel(TIME_TITLE)
    _legend(figure, methods, explained)
    return figure


def _rows_of_two(figure: Figure, rows: int) -> list[list[Axes]]:
    """Returns two panels a row; on narrow paper each below the other."""
    if canvas.most_across(2) == 2:
        grid = figure.subplots(rows, 2, squeeze=False, sharex="row", width_ratios=(1.12, 1.0))
    else:
        figure.set_figheight(2 * figure.get_figheight())
        grid = figure.subplots(2 * rows, 1).reshape(rows, 2)
    return [list(row) for row in grid]


@canvas.styled
def draw_speeds(
    trajectory: PairTrajectory, methods: Sequence[str], errors: Mapping[str, float]
) -> Figure:
    """Draw the simulated speed of each method against the real driver's, a panel per method.

    Args:
        trajectory: the pair.
        methods: those to show.
        errors: by method, RMSE of speed, m/s.
    """
    figure = canvas.blank(0.8 + 1.9 * len(methods))
    grid = figure.subplots(len(methods), 1, sharex=True, squeeze=False)[:, 0]
    for axes, method in zip(grid, methods, strict=True):
        simulated = {method: trajectory.speed[method]}
        canvas.draw_lines(axes, _lines(trajectory.time, trajectory.real_speed, simulated, [method]))
        title = f"{wording.method_label(method)}: RMSE of speed {errors[method]:.3f} m/s"
        axes.set_title(title, fontsize=canvas.points(9.5), color=colours.INK)
        axes.set_ylabel("speed (m/s)")
    grid[-1].set_xlabel(TIME_TITLE)
    title = f"pair {wording.shortened(trajectory.pair_id, 60)}, test part"
    canvas.method_legend(figure, ["real", *methods], title)
    return figure


@canvas.styled
def draw_parameters(pair: PairPanels, methods: Sequence[str]) -> Figure:
    """Draws the parameters that each method used over time, a small panel per parameter.

    The first panel shows the speeds, so that a reader sees what the policy answers to. What lies
    outside a parameter's bounds is shaded, and its bounds and its meaning stand in the title.
    """
    count = len(pair.parameters)
    columns = min(_columns(count), canvas.most_across(4))
    rows = -(-(count + 1) // columns)
    figure = canvas.blank(1.0 + (1.75 if columns == 1 else 2.0) * rows)
    grid = figure.add_gridspec(rows, columns)
    # The speeds take the cells that the parameters leave over, so that the grid has no hole.
    span = rows * columns - count
    speeds = figure.add_subplot(grid[0, :span])
    lines = [line for line in pair.speed.lines if line.method in {"leader", "real", "policy"}]
    canvas.draw_lines(speeds, lines)
    speeds.set_title(pair.speed.title)
    panels = [speeds]
    panels += _draw_parameters(speeds, grid, pair.parameters, first=span)
    # Shared by all; labels of small axes must not touch.
    speeds.xaxis.set_major_locator(MaxNLocator(12 // columns, integer=True))
    for axes in panels:
        axes.tick_params(labelbottom=axes in panels[-columns:])
    _finish(figure, methods, f"pair {wording.shortened(pair.pair_id, 60)}")
    return figure


@canvas.styled
def draw_pair(result: Result, pair_id: str) -> Figure:
    """Draws speed, gap and each tuned parameter of one pair over the test part.

    Raises:
        ConfigError: the pair id is not in the results.
    """
    ((_, trajectory),) = chosen_pairs(result, pair_id, 1)
    pair = pair_panels(trajectory, result.shown_methods, result.parameters)
    columns = max(2, canvas.most_across(2 if len(pair.parameters) <= 4 else 4))
    rows = -(-len(pair.parameters) // columns)
    figure = canvas.blank(3.4 + 1.75 * rows)
    grid = figure.add_gridspec(rows + 1, columns, height_ratios=(1.6, *[1.0] * rows))
    speeds = figure.add_subplot(grid[0, : columns // 2])
    gaps = figure.add_subplot(grid[0, columns // 2 :], sharex=speeds)
    draw_panel(speeds, pair.speed)
    draw_panel(gaps, pair.gap)
    _draw_parameters(speeds, grid, pair.parameters, first=columns)
    _finish(figure, result.shown_methods)
    return figure


def _draw_parameters(
    speeds: Axes, grid: GridSpec, panels: Sequence[Panel], first: int
) -> list[Axes]:
    """Draws a panel for each parameter into the cells of a grid from the `first` on."""
    drawn = []
    for k, panel in enumerate(panels, start=first):
        place = grid[divmod(k, grid.ncols)]
        axes = speeds.figure.add_subplot(place, sharex=speeds)
        draw_panel(axes, panel)
        _titles_of_parameter(axes, panel, _LINE // grid.ncols)
        axes.set_ylabel("")
        drawn.append(axes)
    return drawn


def _finish(figure: Figure, methods: Sequence[str], title: str | None = None) -> None:
    """Says below all panels what time they share, and above them who drives."""
    figure.supxlabel(TIME_TITLE, fontsize=canvas.points(10.5), color=colours.INK)
    _legend(figure, methods, title)


def _legend(figure: Figure, methods: Sequence[str], title: str | None = None) -> None:
    canvas.method_legend(figure, ["real", "leader", *_visible(methods)], title)


def _visible(methods: Sequence[str]) -> list[str]:
    """Returns the methods that figures show."""
    return [method for method in methods if method not in canvas.HIDDEN]


def draw_panel(axes: Axes, panel: Panel) -> None:
    """Draws lines, notes, collisions and bounds of one panel."""
    canvas.draw_lines(axes, panel.lines)
    if panel.low is not None and panel.high is not None:
        axes.set_ylim(panel.low, panel.high)
        if panel.bounds is not None:
            _shade_outside(axes, panel.bounds, panel.low, panel.high)
    axes.set_ylabel(panel.title)
    for text, above in panel.notes:
        _write_note(axes, text, above=above)
    for method, time, gap in panel.collisions:
        colour, place = colours.colour_of(method), (time, gap)
        axes.plot(*place, marker="X", markersize=9, color=colour, mec="white", zorder=6)
        axes.annotate(
            f"{wording.short_label(method)} collides",
            place,
            (6, 6),
            textcoords="offset points",
            color=colour,
            fontsize=canvas.points(9),
            annotation_clip=True,
        )
        axes.axhline(0, color=colours.INK, linewidth=0.8)


def _columns(parameters: int) -> int:
    for columns, most in ((1, 2), (2, 5), (3, 8)):
        if parameters <= most:
            return columns
    return 4


def _shade_outside(axes: Axes, bounds: tuple[float, float], low: float, high: float) -> None:
    width = high - low
    axes.axhspan(min(low, bounds[0]) - width, bounds[0], color=colours.BAND, zorder=0)
    axes.axhspan(bounds[1], max(high, bounds[1]) + width, color=colours.BAND, zorder=0)
    for bound in bounds:
        axes.axhline(bound, color=colours.EDGE, linewidth=0.9, zorder=1)
    axes.set_ylim(low, high)


def _titles_of_parameter(axes: Axes, panel: Panel, length: int) -> None:
    """Writes name, unit and bounds, and below them what the parameter means."""
    title = panel.title
    if panel.bounds is not None:
        title += (
            f", {wording.number_text(panel.bounds[0])} to {wording.number_text(panel.bounds[1])}"
        )
    lines = textwrap.wrap(panel.meaning, length, max_lines=2, placeholder=" …")
    axes.set_title("\n".join(lines), fontsize=canvas.points(8), color=colours.INK)
    _above(axes, title, canvas.points(6 + 11 * len(lines)), fontsize=canvas.points(10.5))


def _two_line_title(axes: Axes, strong: str, fine: str) -> None:
    # Several methods' errors stand beside each other.
    axes.set_title(fine, fontsize=canvas.points(7.6), color=colours.INK)
    if strong:
        # On narrow paper the errors need two lines.
        above = 20 if canvas.most_across(2) == 2 else 30
        _above(axes, strong, canvas.points(above), fontsize=canvas.points(11), fontweight="bold")


def _above(axes: Axes, text: str, points: float, **font: Any) -> None:
    """Write a line so many points above a panel."""
    axes.annotate(
        text,
        (0, 1),
        (0, points),
        xycoords="axes fraction",
        textcoords="offset points",
        color="black",
        va="bottom",
        wrap=True,
        **font,
    )


def _write_note(axes: Axes, text: str, *, above: bool) -> None:
    height, aligned = (0.97, "top") if above else (0.03, "bottom")
    axes.text(
        0.985,
        height,
        text,
        transform=axes.transAxes,
        ha="right",
        va=aligned,
        color=colours.colour_of("default"),
        fontsize=canvas.points(9),
        bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.5},
        zorder=5,
    )


def drives(result: Result, pair_id: str | Sequence[str] | None = None, count: int = 3) -> Figure:
    """Speed and gap over the test part, a row per pair.

    Args:
        result: of a job.
        pair_id: the pairs to show; None for `count` pairs from the best to the worst improvement,
            without a policy from the smallest to the largest error.
        count: how many.

    Raises:
        ConfigError: a pair id is not in the results.
    """
    titles, panels = [], []
    explained: str | None = None
    for ranked, trajectory in chosen_pairs(result, pair_id, count):
        name = RankedPair(wording.shortened(ranked.pair_id), ranked.rank, ranked.improvement).title
        if np.isfinite(ranked.improvement):
            name += f":  {wording.percent(ranked.improvement)}"
            title = improvement_title("driver_specific", result.judge.heading)
            explained = f"percentages: {title}"
        elif {"driver_specific", "policy"} <= set(result.shown_methods):
            name += ":  improvement undefined"
        speed = _errors_text(result, trajectory.pair_id, "speed", "m/s")
        titles.append((name, speed, _errors_text(result, trajectory.pair_id, "gap", "m")))
        panels.append(pair_panels(trajectory, result.shown_methods, result.parameters))
    return draw_pairs(titles, panels, result.shown_methods, explained)


class Drives(JobFigure):
    """Speed and gap of the best, the median and the worst pair."""

    title = "Speed and gap of the best, the median and the worst pair"
    caption = "The test part of three pairs, simulated behind the recorded leader by each method."
    order = 20

    def draw(self, result: Result) -> Figure | None:
        """Draws it where trajectories are known."""
        return drives(result) if len(result.trajectories) else None


class Speeds(JobFigure):
    """The paper's speed plots: each method's speed against the real driver's."""

    title = "Speed of each method against the real driver's, median pair"
    caption = "The test part of the pair in the middle, a panel per method."
    order = 30

    def is_usual(self, result: Result) -> bool:
        """Returns False: `drives` shows the speeds of three pairs."""
        return False

    def draw(self, result: Result) -> Figure | None:
        """Draws it where trajectories are known."""
        if not len(result.trajectories):
            return None
        ((_, trajectory),) = chosen_pairs(result, None, 1)
        errors = _errors(result, trajectory.pair_id, "speed")
        return draw_speeds(trajectory, result.shown_methods, errors)


class ChosenParameters(JobFigure):
    """The parameters that each method used over time."""

    title = "Parameters of each method over time, median pair"
    caption = "The test part of the pair in the middle; what lies outside the bounds is shaded."
    order = 50

    def draw(self, result: Result) -> Figure | None:
        """Draws it where trajectories are known."""
        if not len(result.trajectories):
            return None
        ((_, trajectory),) = chosen_pairs(result, None, 1)
        pair = pair_panels(trajectory, result.shown_methods, result.parameters)
        return draw_parameters(pair, result.shown_methods)


def chosen_pairs(
    result: Result, pair_id: str | Sequence[str] | None, count: int
) -> list[tuple[RankedPair, PairTrajectory]]:
    """Returns the pairs that a figure shows, with their test parts.

    Args:
        result: of a job.
        pair_id: their ids; None for `count` pairs, as `drives` takes them.
        count: how many.

    Raises:
        ConfigError: a pair id is not in the results.
    """
    by_id = {trajectory.pair_id: trajectory for trajectory in result.trajectories}
    is_calibration = "policy" not in result.shown_methods
    judged = "policy"
    if is_calibration:  # driver-specific parameters, which stand last, if there are any
        judged = _visible(result.shown_methods)[-1]
    rows = result.pairs[result.pairs["method"] == judged]
    rows = rows[rows["pair_id"].isin(list(by_id))]
    gains = pd.Series(np.nan, index=rows["pair_id"].astype(str))
    # Without driver-specific calibration there is nothing to be better than.
    if "improvement_over_driver_specific" in rows and not is_calibration:
        gains[:] = rows["improvement_over_driver_specific"].to_numpy(dtype=float)
    if pair_id is None:
        values = gains.to_numpy(dtype=float)
        if is_calibration:
            values = -rows[result.judge.name].to_numpy(dtype=float)
        best_and_worst = []
        for pair in rank_pairs(list(gains.index), values, count):
            # A calibration alone has nothing to be better than.
            improvement = math.nan if is_calibration else pair.improvement
            ranked = RankedPair(pair.pair_id, pair.rank, improvement)
            best_and_worst.append((ranked, by_id[pair.pair_id]))
        return best_and_worst
    ids = [pair_id] if isinstance(pair_id, str) else list(pair_id)
    chosen = []
    for name in ids:
        if name not in by_id:
            hint = nearest(name, by_id)
            raise ConfigError(f"pair '{name}' is not in these results.{hint}")
        chosen.append((RankedPair(name, "", float(gains[name])), by_id[name]))
    return chosen


def _errors(result: Result, pair_id: str, signal: str) -> dict[str, float]:
    """Returns the RMSE of a signal of one pair by method, in the methods' order."""
    rows = result.pairs[result.pairs["pair_id"] == pair_id].drop_duplicates("method")
    by_method = rows.set_index("method")[f"rmse_{signal}"]
    errors = {}
    for method in result.shown_methods:
        if method in by_method:
            errors[method] = float(by_method[method])
    return errors


def _errors_text(result: Result, pair_id: str, signal: str, unit: str) -> str:
    """Returns a title such as "RMSE of speed (m/s): default 1.02, policy 0.31"."""
    errors = _errors(result, pair_id, signal)
    texts = []
    for method in _visible(list(errors)):
        value = f"{errors[method]:.2f}" if np.isfinite(errors[method]) else "none"
        texts.append(f"{wording.short_label(method)} {value}")
    return f"RMSE of {signal} ({unit}): {', '.join(texts)}"


@dataclass(frozen=True)
class RankedPair:
    """A pair worth a look.

    Attributes:
        pair_id: which pair.
        rank: "best", "median", "worst", "3 of 12"; "" where there is nothing to rank.
        improvement: of the error over driver-specific calibration, a fraction; NaN where
            it is not defined.
    """

    pair_id: str
    rank: str
    improvement: float

    @property
    def title(self) -> str:
        """How a figure names it: "best pair, i80-11-1"."""
        return f"{self.rank} pair, {self.pair_id}" if self.rank else f"pair {self.pair_id}"


def rank_pairs(
    pair_ids: Sequence[str], improvements: NDArray[np.floating], count: int = 3
) -> tuple[RankedPair, ...]:
    """Returns `count` pairs from the best to the worst improvement; of one the median.

    Pairs whose improvement is not defined do not take part, unless no pair has a defined one: then
    the first pairs come without a rank.

    Args:
        pair_ids: of P pairs.
        improvements: `(P,)`, fractions.
        count: at most so many.
    """
    values = np.asarray(improvements, dtype=np.float64)
    order = np.argsort(-np.where(np.isfinite(values), values, -np.inf), kind="stable")
    defined = int(np.isfinite(values).sum())
    chosen = []
    if not defined:
        for pair_id in pair_ids[:count]:
            chosen.append(RankedPair(str(pair_id), "", float("nan")))
        return tuple(chosen)
    for place in evenly_spread(defined, count):
        index = int(order[place])
        rank = _rank(place, defined, count)
        chosen.append(RankedPair(str(pair_ids[index]), rank, float(values[index])))
    return tuple(chosen)


def evenly_spread(available: int, count: int) -> list[int]:
    """Returns up to `count` places from the first to the last of `available`; of one the middle."""
    if count == 1 or available == 1:
        return [available // 2]
    count = min(count, available)
    places = []
    for k in range(count):
        # k (available - 1) / (count - 1), rounded half up in whole numbers: of an even number the
        # middle is the later one, as for a single place.
        places.append((2 * k * (available - 1) + count - 1) // (2 * (count - 1)))
    return places


def _rank(place: int, available: int, count: int) -> str:
    if available == 1:
        return ""
    if count == 1:
        return "median"
    if place == 0:
        return "best"
    if place == available - 1:
        return "worst"
    return "median" if count == 3 else f"{place + 1} of {available}"
