"""What the tables of simulated traffic amount to: methods, means and metrics."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pandas as pd

from cfx.plugin import RECORDED

TRAFFIC_METHODS = (
    "pooled",
    "pooled_ar",
    "driver_specific",
    "driver_specific_ar",
    "policy",
    "policy_sampled",
)
"""What drives in traffic, in the order in which it is shown.

`pooled`: pooled parameters, the same for every vehicle.
`driver_specific`: driver-specific parameters; each vehicle has those of a recorded driver.
`pooled_ar`, `driver_specific_ar`: the same with AR(1) noise on the acceleration, as measured.
`policy`: the policy, nothing drawn; each vehicle is a recorded driver that it has observed.
`policy_sampled`: the same, with all that a stochastic policy leaves to chance.
"""

BIN_PER_KM = 10.0
"""Width of the bins of density in which flows are compared, vehicles/km."""

_LEAST_STRIPS = 10
"""Strips that a bin must have to count."""


def traffic_metrics(
    roads: pd.DataFrame, growth: pd.DataFrame, strips: pd.DataFrame, real_wave_speed: float
) -> dict[str, float]:
    """Return the metrics of simulated traffic, beside the recording, under their MLflow names.

    METHOD is as in `TRAFFIC_METHODS`:
        `traffic/capacity/METHOD`: the largest mean flow of a ring over all densities, vehicles/h.
        `traffic/flow_error/METHOD`: RMS difference to the recording of the mean flow in bins of
            local density, vehicles/h, over the bins that both have.
        `traffic/speed_std/METHOD`, `/real`: standard deviation of a vehicle's speed in 10 s, mean
            over the bins of density that all have, m/s.
        `traffic/wave_speed/METHOD`, `/real`: from vehicle to vehicle, km/h, median over the rings
            that have waves, or over all recorded pairs (`PairWaves.speed`); NaN without waves.
        `traffic/growth_last/METHOD`: standard deviation of the speed of a platoon's last vehicle,
            m/s, mean over the leaders' speeds.
        `traffic/growth_half/METHOD`: the same of the vehicle half-way, over that of the last: 0.5
            where it grows linearly, more where the growth is concave, less where it is convex; NaN
            where the last one's is below 0.05 m/s.
        `traffic/discharge/METHOD`: the flow out of the bottleneck at the largest demand,
            vehicles/h.
        `traffic/collisions/METHOD`: vehicles on all roads whose gap was negative.
        `traffic/outside/METHOD`: share of windows outside what the policy has learned from.

    Args:
        roads, growth, strips: the tables `Roads`, `Growth` and `Strips`.
        real_wave_speed: of the recording, km/h (`PairWaves.speed`).
    """
    metrics: dict[str, float] = {}
    bins = binned(strips)
    errors = flow_errors(bins)
    variations = common_variation(bins)
    for method in traffic_methods(roads):
        rows = roads[roads["method"] == method]
        values = _of_roads(rows) | _of_growth(growth[growth["method"] == method])
        values["flow_error"] = errors.get(method, math.nan)
        values["speed_std"] = variations.get(method, math.nan)
        for name, value in values.items():
            metrics[f"traffic/{name}/{method}"] = value
    metrics[f"traffic/wave_speed/{RECORDED}"] = real_wave_speed
    metrics[f"traffic/speed_std/{RECORDED}"] = variations.get(RECORDED, math.nan)
    return metrics


def traffic_methods(roads: pd.DataFrame) -> tuple[str, ...]:
    """Returns the methods of a table of roads in the order in which they are shown."""
    present = roads["method"].astype(str).unique().tolist()
    ordered = [method for method in TRAFFIC_METHODS if method in present]
    return (*ordered, *(method for method in present if method not in ordered))


def binned(strips: pd.DataFrame) -> pd.DataFrame:
    """Returns means in bins of local density, of bins with ten strips or more.

    The mean flow is Edie's of all strips of a bin together: their ways over their areas.

    Args:
        strips: the table `Strips`.

    Returns:
        A row per method and bin: method, density (the middle), flow, speed_std, strips.
    """
    middle = (np.floor(strips["density"] / BIN_PER_KM) + 0.5) * BIN_PER_KM
    # A strip's area is its duration over its density, and all have the same duration.
    area = 1.0 / strips["density"]
    table = strips.assign(middle=middle, area=area, way=area * strips["flow"])
    grouped = table.groupby(["method", "middle"], sort=True, observed=True)
    sums = grouped[["area", "way"]].sum()
    bins = pd.DataFrame(
        {
            "flow": sums["way"] / sums["area"],
            "speed_std": grouped["speed_std"].mean(),
            "strips": grouped.size(),
        }
    )
    bins = bins.reset_index().rename(columns={"middle": "density"})
    return bins[bins["strips"] >= _LEAST_STRIPS].reset_index(drop=True)


def flow_errors(bins: pd.DataFrame) -> dict[str, float]:
    """Returns by method the RMS difference of flows to the recording, over the bins of both."""
    wide = bins.pivot_table(index="density", columns="method", values="flow")
    errors: dict[str, float] = {}
    if RECORDED not in wide:
        return errors
    for method in wide:
        off = (wide[method] - wide[RECORDED]).dropna()
        if method != RECORDED and len(off):
            errors[str(method)] = float(np.sqrt((off**2).mean()))
    return errors


def common_variation(bins: pd.DataFrame) -> dict[str, float]:
    """Returns by method the mean standard deviation of speeds over the bins that all have."""
    wide = bins.pivot_table(index="density", columns="method", values="speed_std").dropna()
    if not len(wide):
        return {}
    return {str(method): float(value) for method, value in wide.mean().items()}


def mean_growth(growth: pd.DataFrame) -> pd.Series:
    """Returns the standard deviation by vehicle, mean over the leaders' speeds, of one method."""
    return growth.groupby("vehicle")["speed_std"].mean().sort_index()


def discharge_at_most(roads: pd.DataFrame) -> float:
    """Returns the flow out of the bottleneck at the largest demand of one method; NaN for none."""
    open_roads = roads[roads["road"] == "open"]
    if not len(open_roads):
        return math.nan
    return float(open_roads.sort_values("level")["discharge"].iloc[-1])


def ring_means(roads: pd.DataFrame, columns: Sequence[str]) -> pd.DataFrame:
    """Returns the rings of one method, mean over repetitions, by density."""
    rings = roads[roads["road"] == "ring"]
    return rings.groupby("level")[list(columns)].mean().sort_index().reset_index()


def _of_roads(roads: pd.DataFrame) -> dict[str, float]:
    rings = roads[roads["road"] == "ring"]
    return {
        "capacity": float(ring_means(roads, ["flow"])["flow"].max()),
        "wave_speed": float(rings["wave_speed"].median()),
        "discharge": discharge_at_most(roads),
        "collisions": float(roads["collisions"].sum()),
        "outside": float(roads["outside"].mean()),
    }


def _of_growth(growth: pd.DataFrame) -> dict[str, float]:
    by_vehicle = mean_growth(growth).to_numpy()
    if not len(by_vehicle):
        return {"growth_last": math.nan, "growth_half": math.nan}
    last = float(by_vehicle[-1])
    half = math.nan
    if last >= 0.05:
        half = float(by_vehicle[(len(by_vehicle) - 1) // 2]) / last
    return {"growth_last": last, "growth_half": half}
