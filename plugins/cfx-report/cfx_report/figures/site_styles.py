"""Driving style by site: scores, what they are made of, and how far apart sites are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from cfx.plugin import JobFigure, Result, StyleResult, canvas, colours, style

_ACROSS = 4
_VIOLIN = 8
"""Drivers from which on their distribution is drawn beside them."""

_TYPE_COLOUR = "#9a9a9a"


@canvas.styled
def draw_site_styles(of_drivers: StyleResult, distances: pd.DataFrame | None) -> Figure:
    """Draws a panel for the score and for each indicator, a row per group of drivers.

    Every driver is a dot; the thick line is from the lower to the upper quartile, the mark the
    median. The last panel has the distances between sites.

    Args:
        of_drivers: of at least two sites.
        distances: as `cfx.data.style.style_distances`.
    """
    shown = style.groups(of_drivers.table)
    across = canvas.most_across(_ACROSS)
    panels = len(style.INDICATORS) + 2
    rows = -(-panels // across)
    figure = canvas.blank(rows * (1.1 + 0.24 * len(shown)))
    grid = figure.subplots(rows, across, squeeze=False)
    axes = list(grid.flat)
    _panel(
        axes[0],
        of_drivers.table["score"].to_numpy(dtype=float),
        shown,
        "style score\n0 conservative, 1 aggressive",
    )
    for panel, indicator in zip(axes[1:], style.INDICATORS, strict=False):
        values = of_drivers.table[indicator.name].to_numpy(dtype=float)
        unit = indicator.unit.replace("2", "²").replace("4", "⁴")
        title = f"{style.name_of_indicator(indicator.name)}\n{unit}"
        if indicator.name in of_drivers.weights:
            title += f"; weight {of_drivers.weights[indicator.name]:.2f}"
        _panel(panel, values, shown, title)
    for number, panel in enumerate(axes[: panels - 1]):
        if number % across:
            panel.set_yticklabels([])
    _matrix(axes[panels - 1], shown, distances)
    for unused in axes[panels:]:
        unused.set_visible(False)
    return figure


def _panel(axes: Axes, values: canvas.Array, shown: Sequence[style.Group], title: str) -> None:
    sites = list(dict.fromkeys(group.site for group in shown))
    scatter = np.random.default_rng(0)
    for place, group in enumerate(shown):
        of_group = values[group.chosen & np.isfinite(values)]
        colour = _TYPE_COLOUR
        if group.driver_type == style.ALL_TYPES:
            colour = colours.JOB_COLOURS[sites.index(group.site) % len(colours.JOB_COLOURS)]
        if len(of_group) >= _VIOLIN and np.ptp(of_group) > 0:
            violin = axes.violinplot(
                of_group, [place], orientation="horizontal", widths=0.85, showextrema=False
            )
            for body in violin["bodies"]:  # type: ignore[attr-defined]  # the stub says Collection
                body.set(facecolor=colour, alpha=0.25, linewidth=0)
        if not len(of_group):
            continue
        # Dots lie apart by chance across their row, so that equal values do not hide one another.
        aside = np.zeros(1)
        if len(of_group) > 1:
            aside = scatter.uniform(-0.16, 0.16, len(of_group))
        axes.plot(
            of_group,
            place + aside,
            ".",
            color=colour,
            markersize=canvas.points(2.5),
            alpha=0.55,
            mew=0,
        )
        low, middle, high = np.quantile(of_group, [0.25, 0.5, 0.75])
        axes.plot([low, high], [place, place], color=colour, linewidth=canvas.points(2.2))
        (mark,) = axes.plot(
            middle,
            place,
            "o",
            color=colour,
            markeredgecolor="white",
            markersize=canvas.points(6),
        )
        canvas.hover(mark, f"{_called(group)}: median {middle:.3g}, {len(of_group)} drivers")
    axes.set_yticks(range(len(shown)), [_called(group) for group in shown])
    for tick, group in zip(axes.get_yticklabels(), shown, strict=True):
        tick.set_fontweight("bold" if group.driver_type == style.ALL_TYPES else "normal")
    axes.set_ylim(len(shown) - 0.4, -0.6)
    axes.set_title(title, fontsize=canvas.points(9.5))
    axes.xaxis.set_major_locator(MaxNLocator(4))
    axes.tick_params(axis="y", length=0)
    axes.grid(visible=False, axis="y")


def _called(group: style.Group) -> str:
    return group.site if group.driver_type == style.ALL_TYPES else group.driver_type


def _matrix(axes: Axes, shown: Sequence[style.Group], distances: pd.DataFrame | None) -> None:
    """Draws the distances between the scores of sites; pale where chance may explain them."""
    sites = [group.site for group in shown if group.driver_type == style.ALL_TYPES]
    number = {site: index for index, site in enumerate(sites)}
    matrix = np.full((len(sites), len(sites)), np.nan)
    p_values = np.ones_like(matrix)
    if distances is not None:
        for _, row in distances[distances["driver_type"] == style.ALL_TYPES].iterrows():
            place = number[str(row["other_site"])], number[str(row["site"])]
            matrix[place], p_values[place] = row["distance"], row["p_value"]
    axes.imshow(np.ma.masked_invalid(matrix), cmap="Blues", vmin=0, aspect="auto")
    largest = np.nanmax(matrix) if np.isfinite(matrix).any() else 1.0
    for (row_number, column), value in np.ndenumerate(matrix):
        if np.isfinite(value):
            doubt = "" if p_values[row_number, column] < 0.05 else "\n(chance)"
            ink = "white" if value > 0.6 * largest else colours.INK
            axes.text(
                column, row_number, f"{value:.2f}{doubt}", ha="center", va="center", color=ink
            )
    axes.set_xticks(range(len(sites)), sites, rotation=30, ha="right")
    axes.set_yticks(range(len(sites)), sites)
    axes.set_xlim(-0.5, len(sites) - 1.5)
    axes.set_ylim(len(sites) - 0.5, 0.5)
    axes.grid(visible=False)
    axes.tick_params(length=0)
    axes.set_title("energy distance\nof the style scores", fontsize=canvas.points(9.5))


class SiteStyles(JobFigure):
    """Driving style by site and type of driver."""

    title = "Driving style by site"
    caption = (
        "Style scores and the six indicators that they are made of, a dot per driver: the mark is"
        " the median, the thick line goes from the lower to the upper quartile. Below each site, in"
        " grey, its types of drivers. Distances between sites are energy distances of the scores;"
        " (chance): a permutation of the drivers does not tell the sites apart."
    )
    order = 61

    def draw(self, result: Result) -> Figure | None:
        """Draws it where drivers of several sites are scored."""
        if result.style is None or not style.groups(result.style.table):
            return None
        return draw_site_styles(result.style, result.tables.get("style_distances"))
