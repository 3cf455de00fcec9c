"""The flow that a driver makes behind a leader of constant speed, against recorded drivers'.

An error of speed says little of the gap at which a driver settles, and the gap decides how many
vehicles a road carries (M. Treiber and A. Kesting 2013, *Traffic Flow Dynamics*, chapter 4).

Shapes: V speeds of leaders, G time gaps at the start, T frames. SI units.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch

from cfx.plugin import Pair, PairBatch, PairSet, steady, traffic
from cfx_report.benchmark.rival import Driver

_SECONDS = 240.0
"""After which the gap is measured."""


def flow_errors(driver: Driver, dt: float) -> dict[str, float]:
    """Returns how far flows are from those of recorded people, and from one another.

    Args:
        driver: nothing of whose past is known.
        dt: time step, s.

    Returns:
        `flow_error`: mean of |flow / recorded flow - 1| over speeds at which people were recorded
        and both starts; `two_gaps`: mean difference of the gaps at which the two starts end, as a
        share of their mean. A collision, or a gap that grows without end, counts as an error of 1.
    """
    speeds = np.array(traffic.SPEEDS_MPS)
    recorded = traffic.recorded_flows("human").at(speeds)
    pairs = _pairs(dt)
    whole = PairBatch.of(pairs)
    first = torch.zeros(len(pairs), dtype=torch.int64)
    blank = torch.arange(whole.mask.shape[1]) > 0
    hidden = {}
    for name in ("follower_position", "follower_speed", "follower_acceleration"):
        hidden[name] = getattr(whole, name).masked_fill(blank, torch.nan)
    speed = driver.drive(replace(whole, **hidden), first, None)
    moved = speed[:, 1:].sum(1) * dt
    ahead = whole.leader_position[:, -1] - whole.leader_position[:, 0]
    gap = (whole.gap[:, 0] + ahead - moved).numpy().reshape(len(speeds), -1)
    final = speed[:, -1].numpy().reshape(gap.shape)
    settled = (gap > 0) & (np.abs(final - speeds[:, None]) < 0.1 * speeds[:, None])
    flows = steady.flow(np.broadcast_to(speeds[:, None], gap.shape), np.where(settled, gap, 1.0))
    is_recorded = np.isfinite(recorded)
    error = np.where(settled, np.abs(flows / recorded[:, None] - 1.0), 1.0)[is_recorded]
    both = settled.all(1)
    apart = math.nan
    if both.any():
        apart = float((np.ptp(gap[both], axis=1) / gap[both].mean(1)).mean())
    return {"flow_error": float(error.mean()), "two_gaps": apart}


def _pairs(dt: float) -> PairSet:
    """Returns leaders of constant speed, V x G, with followers as fast as they."""
    frames = round(_SECONDS / dt) + 1
    time = np.linspace(0.0, (frames - 1) * dt, frames)
    still = np.zeros(frames)
    pairs = []
    for speed in traffic.SPEEDS_MPS:
        for time_gap in traffic.TIME_GAPS_S:
            gap = time_gap * speed
            pairs.append(
                Pair(
                    pair_id=f"{speed:g} m/s, {time_gap:g} s",
                    recording="constant",
                    leader_id="0",
                    follower_id="1",
                    first_frame=0,
                    dt=dt,
                    leader_length=steady.VEHICLE_M,
                    leader_position=gap + steady.VEHICLE_M + speed * time,
                    leader_speed=np.full(frames, speed),
                    leader_acceleration=still,
                    follower_position=speed * time,
                    follower_speed=np.full(frames, speed),
                    follower_acceleration=still,
                )
            )
    return PairSet(tuple(pairs), "leaders of constant speed")
