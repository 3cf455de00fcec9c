"""The leaderboard: rows of a suite as one HTML file, with pictures of what they drove."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from cfx.plugin import canvas, files
from cfx_report.benchmark.board import (
    HEADINGS,
    Entered,
    Standing,
    cell,
    is_shown,
    standings,
    suite_of,
)
from cfx_report.benchmark.row import DRIVES
from cfx_report.inline import PLACE, inline_scripts, inline_svg, security_policy
from cfx_report.page import asset, templates
from cfx_report.section import Cell, Column, Sheet

_SCRIPTS = ("sortable/sortable.min.js", "sortable/sortable.a11y.min.js")


def write_page(rows: Sequence[Entered], output: Path) -> Path:
    """Writes the page; returns its path.

    Args:
        rows: of one suite, the baseline among them.
        output: the file; what was there is replaced once the page is complete.

    Raises:
        DataError: the rows do not compare.
        OutputError: the page cannot be written.
    """
    files.write_output(output, render(rows), "the leaderboard")
    return output


def render(rows: Sequence[Entered]) -> str:
    """Returns the page as HTML."""
    from markupsafe import Markup

    environment = templates()
    blocks: Any = environment.get_template("blocks.html.j2").module
    environment.globals["table"] = blocks.table
    suite = suite_of(rows)
    ranked = standings(rows)
    scripts = inline_scripts([asset(name) for name in _SCRIPTS])
    return environment.get_template("leaderboard.html.j2").render(
        suite=suite,
        protocol=rows[0].row.protocol,
        written=f"{datetime.now():%d %B %Y}".lstrip("0"),
        tasks=[
            (standing.task, task_sheet(standing), site_sheet(standing), standing.verdict)
            for standing in ranked
        ],
        cards=[entered.row for entered in rows if entered.row.card],
        drives=[
            (entered.row.name, Markup(svg))  # noqa: S704 - Matplotlib escapes all texts
            for entered, svg in _pictures(rows)
        ],
        commands=[(entered.row.name, entered.row.command) for entered in rows],
        style=asset("page.css"),
        # Nothing of a row's data is in them.
        scripts=[Markup(script) for script in scripts],  # noqa: S704
        security=security_policy(scripts),
    )


def task_sheet(standing: Standing) -> Sheet:
    """Returns a task's table for the page."""
    columns: list[Column[Mapping[Any, Any]]] = [Column("Row", _name)]
    for name in standing.table.columns:
        if name not in {"row", "low", "high"} and is_shown(standing, name):
            columns.append(Column(HEADINGS.get(name, name), _shown(name)))
    return Sheet.of(tuple(columns), standing.table.to_dict("records"))


def site_sheet(standing: Standing) -> Sheet:
    """Returns the errors by site for the page."""
    table = standing.sites.rename_axis("row").reset_index()
    columns: list[Column[Mapping[Any, Any]]] = [Column("Row", _name)]
    for site in standing.sites.columns:
        columns.append(Column(str(site), _shown(str(site))))
    return Sheet.of(tuple(columns), table.to_dict("records"))


def _name(line: Mapping[Any, Any]) -> str:
    return str(line["row"])


def _shown(name: str) -> Any:
    """Returns what shows a column: its text, sorted by the number; the best first for scores."""

    def show(line: Mapping[Any, Any]) -> Cell:
        value = float(line[name])
        if math.isnan(value):
            return Cell("")
        order = -value if name == "score" else value
        return Cell(cell(line, name), number=True, sort=f"{order:.9g}")

    return show


def _pictures(rows: Sequence[Entered]) -> list[tuple[Entered, str]]:
    """Returns drawings of the best, the median and the worst drive of each row that has them."""
    pictures = []
    for number, entered in enumerate(rows):
        path = entered.folder / DRIVES
        if path.is_file():
            svg = inline_svg(_drawn(pd.read_parquet(path)))
            pictures.append((entered, svg.replace(PLACE, f"row{number}-")))
    return pictures


@canvas.styled
def _drawn(drives: pd.DataFrame) -> Figure:
    """Draws the speeds of a row's drives side by side, driven, recorded and the leader's."""
    figure = canvas.blank(2.4)
    panels = figure.subplots(1, drives["drive"].nunique(), squeeze=False)[0]
    for panel, (drive, rows) in zip(panels, drives.groupby("drive", sort=False), strict=True):
        time = rows["time_s"].to_numpy()
        lines = []
        for method, column in (("leader", "leader"), ("real", "recorded"), ("policy", "driven")):
            lines.append(canvas.Line(method, time, rows[column].to_numpy()))
        canvas.draw_lines(panel, lines)
        panel.set_title(f"{drive}: {rows['site'].iloc[0]}, {rows['rmse_speed'].iloc[0]:.2f} m/s")
        panel.set_xlabel("time (s)")
    panels[0].set_ylabel("speed (m/s)")
    return figure
