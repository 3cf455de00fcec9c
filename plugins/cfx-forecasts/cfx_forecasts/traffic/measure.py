"""From simulated roads to the tables of `cfx_forecasts.traffic.tables`.

Shapes: D vehicles of all roads, P recorded pairs, W stored frames.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from cfx.plugin import RECORDED, PairBatch, roads, waves
from cfx_forecasts.traffic.edie import PER_HOUR, PER_KM, Strips, region, strips_of
from cfx_forecasts.traffic.tables import GROWTH_COLUMNS, PATH_COLUMNS, ROAD_COLUMNS, STRIP_COLUMNS

KMH = 3.6

UPSTREAM_M = 500.0
"""The stretch before a bottleneck, and after it, in which flow and density are measured."""

PATH_STEP_S = 1.0
"""Time between the points of `paths`."""

_MOST_STRIPS = 20_000
"""Strips of a method that are kept."""


class Settled(NamedTuple):
    """Vehicles once all have found their places; `(D, W)` each.

    Attributes:
        position, speed: m and m/s.
        ahead: position of the vehicle ahead, m.
        ahead_speed: m/s.
        interval: s between frames.
    """

    position: Tensor
    speed: Tensor
    ahead: Tensor
    ahead_speed: Tensor
    interval: float

    @classmethod
    def of(cls, driven: roads.Driven, lanes: roads.Lanes, settle: float) -> Settled:
        """Leaves out the first seconds."""
        first = round(settle / driven.interval)
        position, speed = driven.position[:, first:], driven.speed[:, first:]
        ahead = position[lanes.ahead] + lanes.offset[:, None]
        return cls(position, speed, ahead, speed[lanes.ahead], driven.interval)

    def of_road(self, road: roads.Road) -> Settled:
        """Returns the vehicles of one road."""
        vehicles = road.vehicles
        return Settled(
            self.position[vehicles],
            self.speed[vehicles],
            self.ahead[vehicles],
            self.ahead_speed[vehicles],
            self.interval,
        )


class Measured(NamedTuple):
    """What was measured of simulated traffic and of the recording.

    Attributes:
        tables: by their names in a job's folder (`cfx_forecasts.traffic.tables`).
        real_wave_speed: of the recording, km/h (`PairWaves.speed`).
        real_waves: pairs of the recording that have one.
    """

    tables: dict[str, pd.DataFrame]
    real_wave_speed: float
    real_waves: int


def traffic_of(
    driven: Mapping[str, roads.Driven], lanes: roads.Lanes, settle: float, batch: PairBatch
) -> Measured:
    """Measures simulated traffic and the recording.

    Args:
        driven: by method.
        lanes: the roads.
        settle: s from the start that do not count.
        batch: P recorded pairs.
    """
    of_roads, growth, strips, paths = [], [], [], []
    shown = _shown_ring(lanes)
    for method, drove in driven.items():
        settled = Settled.of(drove, lanes, settle)
        for road in lanes.roads:
            of_roads.append(
                {"method": method} | _road_row(road, drove, settled.of_road(road), lanes)
            )
        growth.append(_growth(method, lanes, settled))
        strips.append(_strips_table(method, _ring_strips(lanes, settled)))
        if shown is not None:
            paths.append(_paths(method, shown, settled.of_road(shown)))
    strips.append(_strips_table(RECORDED, recorded_strips(batch)))
    of_recording = recorded_waves(batch)
    tables = {
        "traffic": pd.DataFrame(of_roads, columns=list(ROAD_COLUMNS)),
        "traffic_growth": pd.concat(growth, ignore_index=True),
        "traffic_strips": pd.concat(strips, ignore_index=True),
        "traffic_paths": pd.concat(
            [pd.DataFrame(columns=list(PATH_COLUMNS)), *paths], ignore_index=True
        ),
    }
    return Measured(tables, KMH * of_recording.speed, of_recording.measured)


def recorded_strips(batch: PairBatch) -> Strips:
    """Returns the strips of recorded pairs."""
    spacing = batch.leader_position - batch.follower_position
    return strips_of(spacing, batch.follower_speed, batch.mask, batch.dt)


def recorded_waves(batch: PairBatch) -> waves.PairWaves:
    """Returns how waves travel in each of P recorded pairs."""
    return waves.pair_waves(
        batch.leader_position,
        batch.leader_speed,
        batch.follower_position,
        batch.follower_speed,
        batch.mask,
        batch.dt,
    )


def _road_row(
    road: roads.Road, driven: roads.Driven, settled: Settled, lanes: roads.Lanes
) -> dict[str, object]:
    """Returns what is measured on one road, by the columns of `ROAD_COLUMNS`."""
    gaps = driven.min_gap[road.vehicles]
    row: dict[str, object] = {
        "road": road.kind,
        "level": road.level,
        "repetition": road.repetition,
        "speed_std": float(settled.speed.std(correction=0)),
        "min_gap": float(gaps.min()),
        "collisions": int((gaps < 0.0).sum()),
        "outside": float(driven.outside[road.vehicles].mean()),
    }
    if road.kind == "ring":
        row |= _of_ring(road, settled)
    if road.kind == "open":
        row |= _of_bottleneck(settled, lanes)
    return row


def _of_ring(road: roads.Road, settled: Settled) -> dict[str, object]:
    """Returns flow and waves of a ring; its area holds all vehicles all the time."""
    density = len(settled.speed) / road.circumference * PER_KM
    mean = float(settled.speed.mean())
    everywhere = torch.ones_like(settled.speed, dtype=torch.bool)
    of_pairs = waves.pair_waves(
        settled.ahead,
        settled.ahead_speed,
        settled.position,
        settled.speed,
        everywhere,
        settled.interval,
    )
    of_ring = waves.ring_waves(
        settled.position, settled.speed, road.circumference, settled.interval
    )
    return {
        "density": density,
        "flow": density / PER_KM * mean * PER_HOUR,
        "speed": mean,
        "wave_speed": KMH * of_pairs.speed,
        "ring_wave_speed": KMH * of_ring.speed,
        "coherence": of_ring.coherence,
    }


def _of_bottleneck(settled: Settled, lanes: roads.Lanes) -> dict[str, object]:
    """Returns what is measured before the bottleneck of an open road, and behind it."""
    zone = lanes.bottleneck
    place = (settled.position, settled.speed)
    before = region(*place, max(0.0, zone.begin - UPSTREAM_M), zone.begin)
    after = region(*place, zone.end, zone.end + UPSTREAM_M)
    return {
        "density": before.density,
        "flow": before.flow,
        "speed": before.speed,
        "discharge": after.flow,
    }


def _growth(method: str, lanes: roads.Lanes, settled: Settled) -> pd.DataFrame:
    """Returns the rows of `Growth` of one method."""
    parts = []
    for road in lanes.roads:
        if road.kind != "platoon":
            continue
        std = settled.speed[road.vehicles].std(-1, correction=0)
        values = {"leader_speed": road.level, "vehicle": np.arange(len(std))}
        parts.append(pd.DataFrame({**values, "square": _array(std.square())}))
    if not parts:
        return pd.DataFrame(columns=list(GROWTH_COLUMNS))
    mean = pd.concat(parts).groupby(["leader_speed", "vehicle"])["square"].mean()
    table = mean.reset_index().assign(method=method, speed_std=np.sqrt(mean.to_numpy()))
    return table[list(GROWTH_COLUMNS)]


def _ring_strips(lanes: roads.Lanes, settled: Settled) -> Strips:
    """Returns the strips of all rings."""
    parts = []
    for road in lanes.roads:
        if road.kind == "ring":
            on_road = settled.of_road(road)
            counted = torch.ones_like(on_road.speed, dtype=torch.bool)
            parts.append(
                strips_of(
                    on_road.ahead - on_road.position, on_road.speed, counted, on_road.interval
                )
            )
    return Strips(*(torch.cat(columns) for columns in zip(*parts, strict=True)))


def _strips_table(method: str, strips: Strips) -> pd.DataFrame:
    """Returns rows of `Strips`; of very many every so manieth."""
    every = max(1, -(-len(strips.density) // _MOST_STRIPS))
    columns = {name: _array(getattr(strips, name)[::every]) for name in STRIP_COLUMNS[1:]}
    return pd.DataFrame({"method": method, **columns})[list(STRIP_COLUMNS)]


def _shown_ring(lanes: roads.Lanes) -> roads.Road | None:
    """Returns the ring whose vehicles are shown: of those in the middle of the densities."""
    rings = [road for road in lanes.roads if road.kind == "ring" and road.repetition == 0]
    return rings[len(rings) // 2] if rings else None


def _paths(method: str, road: roads.Road, settled: Settled) -> pd.DataFrame:
    """Returns rows of `Paths` of one method."""
    every = max(1, round(PATH_STEP_S / settled.interval))
    position, speed = _array(settled.position[:, ::every]), _array(settled.speed[:, ::every])
    vehicle, frame = np.indices(position.shape).reshape(2, -1)
    table = pd.DataFrame(
        {
            "method": method,
            "vehicle": vehicle.astype(np.int16),
            "time_s": np.round(frame * every * settled.interval, 6),
            "place": np.mod(position, road.circumference).reshape(-1).astype(np.float32),
            "speed": speed.reshape(-1).astype(np.float32),
        }
    )
    return table[list(PATH_COLUMNS)]


def _array(values: Tensor) -> np.ndarray:
    return np.asarray(values.double().cpu().numpy())
