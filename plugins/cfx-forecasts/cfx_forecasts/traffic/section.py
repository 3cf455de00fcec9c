"""Traffic of sampled drivers: fundamental diagram, waves, growth along platoons."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import Any

import pandas as pd

from cfx.plugin import RECORDED, Result, key_of
from cfx_forecasts.traffic.summary import traffic_methods
from cfx_report.jobs import Runs
from cfx_report.section import Cell, Column, Section, Sheet, method_cell, methods_explained, number

_COLUMNS = (
    ("Capacity (1/h)", "capacity", ".0f", "Largest mean flow of a ring over all densities."),
    (
        "Error of flow (1/h)",
        "flow_error",
        ".0f",
        "RMS difference to the recorded flow at the same local density.",
    ),
    (
        "Std of speed (m/s)",
        "speed_std",
        ".2f",
        "Standard deviation of a vehicle's speed in 10 s, over densities that all have.",
    ),
    (
        "Waves (km/h)",
        "wave_speed",
        ".1f",
        "From vehicle to vehicle on rings, median over rings; or recorded.",
    ),
    (
        "Last of platoon (m/s)",
        "growth_last",
        ".2f",
        "Standard deviation of the last vehicle's speed behind a leader of constant speed.",
    ),
    (
        "Half-way / last",
        "growth_half",
        ".2f",
        "The same of the vehicle half-way, over that of the last: above 0.5 where growth is"
        " concave, as of people, below where it is convex.",
    ),
    (
        "Discharge (1/h)",
        "discharge",
        ".0f",
        "Flow out of the bottleneck of the open road at the largest demand.",
    ),
    ("Collisions", "collisions", ".0f", "Vehicles whose gap was negative at any time."),
    ("Outside", "outside", ".1%", "Share of windows outside what the policy has learned from."),
)


class TrafficSection(Section):
    """Traffic of sampled drivers: fundamental diagram, waves, growth along platoons."""

    title = "Traffic of sampled drivers"
    entry = "Traffic"
    order = 900
    figures = ("traffic", "traffic_paths")
    template = """
<p>Each vehicle of a road is a recorded driver, drawn with replacement; all methods have the same
drivers at the same places. Lines over density: means of ring roads. Grey points and the black line
are recorded: strips between a follower and its leader of 10 s, whose density is 1 over the mean
spacing and whose flow is the follower's way over the strip's area (Edie's definitions). Waves: how
fast changes of speed travel from vehicle to vehicle; the band, \N{MINUS SIGN}20 to
\N{MINUS SIGN}15 km/h, is what people show in congestion. The last panel has platoons behind leaders
that keep their speed: what vehicles add by themselves.</p>
<p>Methods: {{ methods }}</p>
{% for job, sheet in roads %}
{% call fold(job.name, loop.first, "job") %}
{{ drawn("traffic", job) }}
{{ table(sheet, explain=true) }}
{% endcall %}
{% endfor %}
"""

    def context(self, runs: Runs) -> Mapping[str, Any] | None:
        """Return a table for each job with traffic."""
        roads = []
        methods: list[str] = []
        for job in runs.jobs:
            table = job.tables.get("traffic")
            if table is not None:
                roads.append((job, traffic_sheet(job, table)))
                methods += traffic_methods(table)
        return {"roads": roads, "methods": methods_explained(methods)} if roads else None


def traffic_sheet(job: Result, roads: pd.DataFrame) -> Sheet:
    """Returns a row per method, and the recorded drivers.

    Args:
        job: of the report.
        roads: the table `Roads`.
    """
    columns = [Column[str]("Driven by", method_cell)]
    for heading, metric, form, meaning in _COLUMNS:
        columns.append(Column(heading, partial(_measure, job, metric, form), meaning))
    return Sheet.of(columns, (*traffic_methods(roads), RECORDED))


def _measure(job: Result, metric: str, form: str, method: str) -> Cell:
    return number(job.metrics.get(key_of(f"traffic/{metric}", method), math.nan), form)
