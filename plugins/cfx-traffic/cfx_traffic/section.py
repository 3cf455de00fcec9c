"""Traffic of sampled drivers: fundamental diagram, waves, growth along platoons."""

from __future__ import annotations

import math

import pandas as pd

from cfx.evaluation.metrics.base import RECORDED, key_of
from cfx.report.blocks import Block, Table, Text, job_fold
from cfx.report.figure_blocks import figure_of
from cfx.report.figures.words import MINUS
from cfx.report.job import Job, Runs
from cfx.report.section import Section
from cfx.report.tables import Cell, Column, Sheet, formatted, method_cell, methods_explained, number
from cfx_traffic.summary import traffic_methods

_INTRODUCTION = (
    "Each vehicle of a road is a recorded driver, drawn with replacement; all methods have the same"
    " drivers at the same places. Lines over density: means of ring roads. Grey points and the"
    " black line are recorded: strips between a follower and its leader of 10 s, whose density is 1"
    " over the mean spacing and whose flow is the follower's way over the strip's area (Edie's"
    " definitions). Waves: how fast changes of speed travel from vehicle to vehicle; the band,"
    f" {MINUS}20 to {MINUS}15 km/h, is what people show in congestion. The last panel has platoons"
    " behind leaders that keep their speed: what vehicles add by themselves."
)

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

    def blocks(self, runs: Runs) -> list[Block]:
        """Return plots and a table for each job with traffic."""
        found: list[Block] = []
        methods: dict[str, None] = {}
        for job in runs.jobs:
            table = job.tables.get("traffic")
            if table is not None:
                found.append(job_fold(job.name, _job_blocks(job, table), first=not found))
                methods |= dict.fromkeys(traffic_methods(table))
        if not found:
            return []
        return [Text(_INTRODUCTION), Text(f"Methods: {methods_explained(methods)}"), *found]


def _job_blocks(job: Job, roads: pd.DataFrame) -> list[Block]:
    figure = figure_of("traffic", job)
    shown: list[Block] = [] if figure is None else [figure]
    shown.append(Table(traffic_sheet(job, roads), explain=True))
    return shown


def traffic_sheet(job: Job, roads: pd.DataFrame) -> Sheet:
    """Returns a row per method, and the recorded drivers.

    Args:
        job: of the report.
        roads: the table `Roads`.
    """
    columns = [Column("Driven by", number=False)]
    columns += [Column(heading, meaning) for heading, _, _, meaning in _COLUMNS]
    rows: list[tuple[Cell, ...]] = []
    for method in (*traffic_methods(roads), RECORDED):
        cells = [method_cell(method)]
        for _, metric, form, _ in _COLUMNS:
            value = job.metrics.get(key_of(f"traffic/{metric}", method), math.nan)
            cells.append(number(value, formatted(value, form)))
        rows.append(tuple(cells))
    return Sheet(tuple(columns), tuple(rows))
