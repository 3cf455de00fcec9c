"""Improvements by site: a row for each road or area, and one in which each counts once."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from cfx.plugin import ALL_SITES, JobFigure, Result, canvas, colours, wording

_PANELS = (("test", "driver_specific"), ("full_trajectory", "pooled"))
"""Which part of trajectories is compared with what, one panel each."""

_WORST = -1.0
"""Ends of intervals beyond this are cut."""


def draw_sites(sites: pd.DataFrame) -> Figure | None:
    """Draws the policy's mean improvement of each site, with its 95 % interval.

    Args:
        sites: as `cfx.evaluation.sites.site_table`.
    """
    panels = []
    for scope, baseline in _PANELS:
        of_scope = sites[sites["scope"] == scope]
        if f"over_{baseline}" in sites and of_scope[f"over_{baseline}"].notna().any():
            panels.append((scope, baseline))
    if not panels:
        return None
    names = list(dict.fromkeys(zip(sites["site"], sites["driver_type"], strict=True)))
    figure = canvas.blank(1.4 + 0.34 * len(names))
    axes = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for panel, (scope, baseline) in zip(axes, panels, strict=True):
        _panel(panel, sites[sites["scope"] == scope], baseline, names)
        part = "last part" if scope == "test" else "full trajectories"
        panel.set_title(f"{part}: over {wording.method_label(baseline)}")
    axes[0].set_yticks(range(len(names)), [_called(*name) for name in names])
    axes[0].invert_yaxis()
    for tick, (site, kind) in zip(axes[0].get_yticklabels(), names, strict=True):
        tick.set_fontweight("bold" if kind == ALL_SITES and site == ALL_SITES else "normal")
    return figure


def _called(site: str, kind: str) -> str:
    if kind != ALL_SITES:
        return kind
    return "mean over sites" if site == ALL_SITES else site


def _panel(axes: Axes, rows: pd.DataFrame, baseline: str, names: list[tuple[str, str]]) -> None:
    places = {name: place for place, name in enumerate(names)}
    for _, row in rows.iterrows():
        value = float(row[f"over_{baseline}"])
        if not np.isfinite(value):
            continue
        place = places[(row["site"], row["driver_type"])]
        is_whole = row["driver_type"] == ALL_SITES
        colour = colours.COLOURS["policy"] if is_whole else "#9a9a9a"
        ends = [float(row[f"over_{baseline}_{end}"]) for end in ("low", "high")]
        if np.isfinite(ends).all():
            axes.plot(np.clip(ends, _WORST, None), [place, place], color=colour, linewidth=2.0)
        (point,) = axes.plot(
            max(value, _WORST), place, "o", color=colour, markersize=7 if is_whole else 5
        )
        canvas.hover(
            point, f"{_called(row['site'], row['driver_type'])}: {wording.percent(value, 1)}"
        )
        axes.annotate(
            wording.percent(value, 1),
            (max(value, _WORST), place),
            (0, 6),
            textcoords="offset points",
            ha="center",
            va="bottom",
            fontsize=8.5,
            color=colours.INK,
        )
    axes.axvline(0, color=colours.INK, linewidth=0.9)
    axes.set_xlabel("improvement, 95 % interval")
    axes.xaxis.set_major_formatter(FuncFormatter(canvas.percent_tick))
    axes.set_ylim(-0.8, len(names) - 0.4)
    axes.grid(visible=False, axis="y")


class SiteImprovements(JobFigure):
    """The policy's improvement at each site, people and automated cars apart."""

    title = "Improvement by site"
    caption = (
        "Mean improvement of the policy at each road or area, with its 95 % interval over drivers;"
        " in grey types of drivers there. In the mean over sites each counts once."
    )
    order = 15

    def draw(self, result: Result) -> Figure | None:
        """Draws it where several sites were tested."""
        table = result.tables.get("sites")
        return None if table is None else draw_sites(table)
