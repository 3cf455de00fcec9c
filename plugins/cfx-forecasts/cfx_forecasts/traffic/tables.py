"""The tables of simulated traffic."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

from rich.table import Table

from cfx.plugin import RECORDED, Column, Evaluation, ResultTable
from cfx_forecasts.console import metrics_table
from cfx_forecasts.traffic.summary import traffic_methods, traffic_metrics

METHOD = Column("method", "", "what drives", "text")


class Roads(ResultTable):
    """What was measured on each simulated road, a row per method and road.

    Density, flow and speed are Edie's, of a whole ring, or of the stretch upstream of the
    bottleneck.
    """

    meaning = "simulated roads (`protocol=traffic`)"
    order = 140
    always_printed = True
    columns = (
        METHOD,
        Column("road", "", "the kind of road", "text"),
        Column(
            "level",
            "as of the road",
            "vehicles/km of a ring, vehicles/h that enter an open road, m/s of a platoon's leader",
        ),
        Column("repetition", "1", "from 0", "int"),
        Column("density", "vehicles/km", "Edie's"),
        Column("flow", "vehicles/h", "Edie's"),
        Column("speed", "m/s", "Edie's"),
        Column("speed_std", "m/s", "of all vehicles' speeds over time"),
        Column("wave_speed", "km/h", "of waves, from vehicle to vehicle"),
        Column("ring_wave_speed", "km/h", "of waves, of the ring as a whole"),
        Column("coherence", "1", "of the ring's waves"),
        Column("discharge", "vehicles/h", "flow downstream of the bottleneck"),
        Column("min_gap", "m", "the smallest gap"),
        Column("collisions", "1", "vehicles whose gap was negative", "int"),
        Column("outside", "1", "share of windows outside what the policy has learned from"),
    )

    def metrics(self, evaluation: Evaluation) -> Mapping[str, float]:
        tables = evaluation.tables
        speed = evaluation.notes["traffic"]["recorded_wave_speed_kmh"]
        return traffic_metrics(
            tables["traffic"],
            tables["traffic_growth"],
            tables["traffic_strips"],
            math.nan if speed is None else speed,
        )

    def console(self, evaluation: Evaluation, metrics: Mapping[str, float]) -> Iterable[Table]:
        title = "Traffic: rings in vehicles/h, m/s and km/h; platoons in m/s; collisions"
        methods = traffic_methods(evaluation.tables["traffic"])
        return [metrics_table(title, (*methods, RECORDED), _SHOWN, metrics)]


class Growth(ResultTable):
    """How much the speeds in a platoon vary, a row per method, leader's speed and vehicle."""

    meaning = "what grows along platoons (`protocol=traffic`)"
    order = 150
    columns = (
        METHOD,
        Column("leader_speed", "m/s", "of the platoon's leader"),
        Column("vehicle", "1", "0 is the leader", "int"),
        Column(
            "speed_std",
            "m/s",
            "standard deviation of the vehicle's speed over time, the root of its mean square over"
            " the repetitions",
        ),
    )


class Strips(ResultTable):
    """Flow and density of pairs of vehicles in strips of time."""

    meaning = "flow and density of pairs of vehicles (`protocol=traffic`)"
    order = 160
    columns = (
        Column("method", "", "what drives; `real` was recorded", "text"),
        Column("density", "vehicles/km", "Edie's, of the strip"),
        Column("flow", "vehicles/h", "Edie's, of the strip"),
        Column("speed_std", "m/s", "standard deviation of the speeds in the strip"),
    )


class Paths(ResultTable):
    """The vehicles of one ring per method."""

    meaning = "the vehicles of one ring (`protocol=traffic`)"
    order = 170
    columns = (
        METHOD,
        Column("vehicle", "1", "number of the vehicle", "int"),
        Column("time_s", "s", "since the start"),
        Column("place", "m", "from 0 to the ring's circumference"),
        Column("speed", "m/s", "simulated"),
    )


def _names(table: type[ResultTable]) -> tuple[str, ...]:
    return tuple(column.name for column in table.columns)


ROAD_COLUMNS = _names(Roads)
GROWTH_COLUMNS = _names(Growth)
STRIP_COLUMNS = _names(Strips)
PATH_COLUMNS = _names(Paths)

_SHOWN = {
    "capacity": ("traffic/capacity", ".0f"),
    "error": ("traffic/flow_error", ".0f"),
    "std": ("traffic/speed_std", ".2f"),
    "waves": ("traffic/wave_speed", ".1f"),
    "last": ("traffic/growth_last", ".2f"),
    "half": ("traffic/growth_half", ".2f"),
    "hits": ("traffic/collisions", ".0f"),
}
"""Columns of the printed table: heading, metric, format. It fits 80 columns."""
