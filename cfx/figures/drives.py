"""The closed loops over time: speeds, gaps, and the parameters that the policy chose."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from cfx.errors import ConfigError, nearest
from cfx.evaluation.result import METHODS, Evaluation, PairTrajectory
from cfx.figures.look import (
    BAND,
    COLOURS,
    INK,
    LABELS,
    canvas,
    method_handles,
    method_line,
    number,
    percent,
    short,
    styled,
    unit_label,
)

Array = NDArray[np.float64]
_SHOWN = tuple(method for method in METHODS if method != "shrunk")
"""The methods whose lines share axes: one more than these and nobody tells them apart. Tables and pages have them all."""

_ROOM = 1.5
"""The default driver may stretch a vertical axis by so many times the range of the other lines, on either side."""


@styled
def drives(
    evaluation: Evaluation, pair_id: str | Sequence[str] | None = None, n: int = 3
) -> Figure:
    """Speed and gap over the test part: the real driver against default, fixed and policy; a row per pair.

    Args:
        pair_id: the pairs to show; None for `n` pairs spread evenly from the best to the worst improvement.

    A default driver far off the others does not shrink them: the axis follows the other lines and a label says how far it goes.

    Raises:
        ConfigError: a pair id is not in the evaluation.
    """
    chosen = _choose(evaluation, pair_id, n)
    figure = canvas(0.75 + 2.35 * len(chosen))
    grid = figure.subplots(len(chosen), 2, squeeze=False, sharex="row", width_ratios=(1.12, 1.0))
    for (speed_axes, gap_axes), (label, drive) in zip(grid, chosen, strict=True):
        rows = _rows(evaluation, drive.pair_id)
        methods = _shown(drive.speed)
        method_line(speed_axes, "leader", drive.time, drive.leader_speed)
        for axes, real, simulated in (
            (speed_axes, drive.real_speed, drive.speed),
            (gap_axes, drive.real_gap, drive.gap),
        ):
            method_line(axes, "real", drive.time, real)
            for method in methods:
                method_line(axes, method, drive.time, _finite(simulated[method]))
        _frame(
            speed_axes,
            [drive.leader_speed, drive.real_speed, *(drive.speed[m] for m in methods)],
            drive.speed.get("default"),
            "m/s",
        )
        near = [drive.real_gap, *(drive.gap[m] for m in methods if m != "default")]
        _frame(gap_axes, near, drive.gap.get("default"), "m")
        _mark_collisions(gap_axes, drive)
        speed_axes.set_ylabel("speed (m/s)")
        gap_axes.set_ylabel("gap (m)")
        improvement = rows["policy"]["improvement"]
        change = percent(improvement) if np.isfinite(improvement) else "improvement undefined"
        _two_line_title(
            speed_axes,
            f"{label}{short(drive.pair_id)}:  {change}",
            _rmse(rows, "rmse_speed", "m/s"),
        )
        _two_line_title(gap_axes, "", _rmse(rows, "rmse_gap", "m"))
        for axes in (speed_axes, gap_axes):
            axes.margins(x=0.01)
    for axes in grid[-1]:
        axes.set_xlabel("time from the start of the pair (s)")
    figure.legend(
        handles=method_handles(("real", "leader", *_shown(evaluation.methods))),
        loc="outside upper center",
        ncols=len(_SHOWN) + 2,
        columnspacing=1.6,
        handlelength=2.4,
    )
    return figure


@styled
def speeds(evaluation: Evaluation, pair_id: str | None = None) -> Figure:
    """The simulated speed of each method against the real driver's, an axis for each method: the paper's three speed plots.

    Args:
        pair_id: the pair to show; None for the one with the median improvement.

    Raises:
        ConfigError: the pair id is not in the evaluation.
    """
    ((_, drive),) = _choose(evaluation, pair_id, 1)
    rows = _rows(evaluation, drive.pair_id)
    figure = canvas(0.8 + 1.9 * len(evaluation.methods))
    panels = figure.subplots(len(evaluation.methods), 1, sharex=True, squeeze=False)[:, 0]
    for axes, method in zip(panels, evaluation.methods, strict=True):
        method_line(axes, "real", drive.time, drive.real_speed)
        method_line(axes, method, drive.time, _finite(drive.speed[method]))
        _frame(axes, [drive.real_speed, drive.speed[method]], None, "m/s")
        _two_line_title(
            axes, "", f"{LABELS[method]}: RMSE of speed {rows[method]['rmse_speed']:.3f} m/s"
        )
        axes.set_ylabel("speed (m/s)")
        axes.margins(x=0.01)
    panels[-1].set_xlabel("time from the start of the pair (s)")
    figure.legend(
        handles=method_handles(("real", *evaluation.methods)),
        loc="outside upper center",
        ncols=min(len(evaluation.methods) + 1, 5),
        columnspacing=1.6,
        handlelength=2.4,
        title=f"pair {short(drive.pair_id, 60)}, test part",
        title_fontsize=11,
    )
    return figure


@styled
def chosen_parameters(evaluation: Evaluation, pair_id: str | None = None) -> Figure:
    """The parameters that the policy chose over time, against the fixed and the default ones; a small axis per parameter.

    The first axis shows the speeds, so that a reader sees what the policy answers to. An axis shows at least a fifth of the
    parameter's range; what lies outside the bounds is shaded, and the bounds stand in the title.

    Args:
        pair_id: the pair to show; None for the one with the median improvement.

    Raises:
        ConfigError: the pair id is not in the evaluation.
    """
    ((_, drive),) = _choose(evaluation, pair_id, 1)
    count = len(evaluation.names)
    columns = 1 if count <= 2 else 2 if count <= 5 else 3 if count <= 8 else 4
    rows = -(-(count + 1) // columns)
    figure = canvas(1.0 + (1.55 if columns == 1 else 1.75) * rows)
    grid = figure.add_gridspec(rows, columns)
    # The speeds take the cells that the parameters leave over, so that the grid has no hole.
    span = rows * columns - count
    speeds = figure.add_subplot(grid[0, :span])
    for signal, values in (
        ("leader", drive.leader_speed),
        ("real", drive.real_speed),
        ("policy", drive.speed.get("policy")),
    ):
        if values is not None:
            method_line(speeds, signal, drive.time, _finite(values))
    speeds.set_title("speed (m/s)")
    panels = [speeds]
    for k, (name, unit) in enumerate(zip(evaluation.names, evaluation.units, strict=True)):
        axes = figure.add_subplot(grid[divmod(k + span, columns)], sharex=speeds)
        _parameter(axes, drive, k, name, unit, evaluation.bounds[:, k])
        panels.append(axes)
    speeds.xaxis.set_major_locator(
        MaxNLocator(12 // columns, integer=True)
    )  # shared by all; labels of small axes must not touch
    for axes in panels:
        axes.margins(x=0.01)
        axes.tick_params(labelbottom=axes in panels[-columns:])
    figure.supxlabel("time from the start of the pair (s)", fontsize=10.5, color=INK)
    figure.legend(
        handles=method_handles(("real", "leader", *_shown(evaluation.methods))),
        loc="outside upper center",
        ncols=len(_SHOWN) + 2,
        columnspacing=1.6,
        title=f"pair {short(drive.pair_id, 60)}",
        title_fontsize=11,
    )
    return figure


def _parameter(
    axes: Axes, drive: PairTrajectory, k: int, name: str, unit: str, bounds: Array
) -> None:
    low, high = float(bounds[0]), float(bounds[1])
    seen = []
    for method in _shown(drive.parameters):
        values = _finite(drive.parameters[method][:, k])
        method_line(axes, method, drive.time, values, steps=True)
        seen.append(values)
    values = np.concatenate(seen) if seen else np.array([low, high])
    values = values[np.isfinite(values)] if np.isfinite(values).any() else np.array([low, high])
    width = max(1.3 * float(values.max() - values.min()), 0.2 * (high - low))
    centre = 0.5 * float(values.max() + values.min())
    margin = 0.06 * width
    bottom, top = max(centre - width / 2, low) - margin, min(centre + width / 2, high) + margin
    axes.axhspan(min(bottom, low) - width, low, color=BAND, zorder=0)
    axes.axhspan(high, max(top, high) + width, color=BAND, zorder=0)
    for bound in (low, high):
        axes.axhline(bound, color="#808080", linewidth=0.9, zorder=1)
    axes.set_ylim(bottom, top)
    axes.set_title(f"{unit_label(name, unit)}, {number(low)} to {number(high)}")


def _choose(
    evaluation: Evaluation, pair_id: str | Sequence[str] | None, n: int
) -> list[tuple[str, PairTrajectory]]:
    """Returns (label, drive) of the pairs to show."""
    by_id = {drive.pair_id: drive for drive in evaluation.trajectories}
    if pair_id is not None:
        wanted = [pair_id] if isinstance(pair_id, str) else list(pair_id)
        for name in wanted:
            if name not in by_id:
                raise ConfigError(f"pair '{name}' is not in this evaluation.{nearest(name, by_id)}")
        return [("pair ", by_id[name]) for name in wanted]
    policy = evaluation.table[evaluation.table["method"] == "policy"]
    improvement = pd.Series(policy["improvement"].to_numpy(dtype=float), index=policy["pair_id"])
    ranked = [
        name
        for name in improvement[np.isfinite(improvement)].sort_values(ascending=False).index
        if name in by_id
    ]
    if not ranked:
        return [("pair ", drive) for drive in evaluation.trajectories[:n]]
    places = (
        [len(ranked) // 2]
        if n == 1
        else sorted({round(x) for x in np.linspace(0, len(ranked) - 1, min(n, len(ranked)))})
    )
    return [(_rank(place, len(ranked), n), by_id[ranked[place]]) for place in places]


def _rank(place: int, count: int, n: int) -> str:
    if count == 1 or n == 1:
        return "pair "
    if place == 0:
        return "best pair, "
    if place == count - 1:
        return "worst pair, "
    return "median pair, " if n == 3 and count > 2 else f"{place + 1} of {count}, "


def _shown(present: Collection[str]) -> list[str]:
    """Returns those of `_SHOWN` that are present, in their order."""
    return [method for method in _SHOWN if method in present]


def _rows(evaluation: Evaluation, pair_id: str) -> dict[str, dict[str, float]]:
    """Returns method -> column -> value of one pair."""
    rows = (
        evaluation.table[evaluation.table["pair_id"] == pair_id]
        .drop_duplicates("method")
        .set_index("method")
    )
    columns = ("rmse_speed", "rmse_gap", "improvement")
    return {
        str(method): {column: float(rows[column][method]) for column in columns}
        for method in rows.index
    }


def _rmse(rows: dict[str, dict[str, float]], column: str, unit: str) -> str:
    values = [(method, rows[method][column]) for method in _shown(rows)]
    what = "speed" if column == "rmse_speed" else "gap"
    listed = ", ".join(
        f"{method} {value:.2f}" if np.isfinite(value) else f"{method} none"
        for method, value in values
    )
    return f"RMSE of {what}: {listed} {unit}"


def _two_line_title(axes: Axes, strong: str, fine: str) -> None:
    axes.set_title(fine, fontsize=8.5, color=INK)  # four methods' errors beside each other
    if strong:
        axes.annotate(
            strong,
            (0, 1),
            (0, 20),
            xycoords="axes fraction",
            textcoords="offset points",
            fontsize=11,
            fontweight="bold",
            color="black",
        )


def _frame(axes: Axes, near: Sequence[Array], default: Array | None, unit: str) -> None:
    """Sets the vertical axis by the lines that matter, and says how far the default driver leaves it."""
    values = np.concatenate([_finite(signal) for signal in near])
    if not np.isfinite(values).any():
        return
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    height = max(high - low, 1.0)
    outer = _finite(default) if default is not None else values
    lowest, highest = low - _ROOM * height, high + _ROOM * height
    bottom = max(lowest, np.nanmin(outer, initial=low)) if np.isfinite(outer).any() else low
    top = min(highest, np.nanmax(outer, initial=high)) if np.isfinite(outer).any() else high
    axes.set_ylim(min(low, bottom) - 0.06 * height, max(high, top) + 0.06 * height)
    if np.isfinite(outer).any():
        most, least = float(np.nanmax(outer)), float(np.nanmin(outer))
        if most > highest:
            _note(axes, f"default up to {number(most)} {unit} ↑", 0.97)
        if least < lowest:
            _note(axes, f"default down to {number(least)} {unit} ↓", 0.03)


def _note(axes: Axes, text: str, height: float) -> None:
    box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.5}
    axes.text(
        0.985,
        height,
        text,
        transform=axes.transAxes,
        ha="right",
        va="top" if height > 0.5 else "bottom",
        color=COLOURS["default"],
        fontsize=9,
        bbox=box,
        zorder=5,
    )


def _mark_collisions(axes: Axes, drive: PairTrajectory) -> None:
    """Marks where a simulated gap becomes negative."""
    for method, gap in drive.gap.items():
        hit = np.flatnonzero(_finite(gap) < 0)
        if len(hit):
            axes.plot(
                drive.time[hit[0]],
                gap[hit[0]],
                marker="X",
                markersize=9,
                color=COLOURS[method],
                markeredgecolor="white",
                zorder=6,
            )
            axes.annotate(
                f"{method} collides",
                (drive.time[hit[0]], gap[hit[0]]),
                (6, 6),
                textcoords="offset points",
                color=COLOURS[method],
                fontsize=9,
                annotation_clip=True,
            )
            axes.axhline(0, color=INK, linewidth=0.8)


def _finite(signal: Array) -> Array:
    """Returns the signal with NaN for infinity, which no axis can show."""
    return np.where(np.isfinite(signal), signal, np.nan)
