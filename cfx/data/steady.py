"""Steady following: where a recording shows at which gap drivers settle, by speed.

A driver follows steadily while the leader is as fast as they are and they hardly accelerate. The
flow of such traffic is the speed over the spacing, so the recorded relation of speed and gap is
the one that a fleet of drivers has to have (M. Treiber and A. Kesting, 2013, *Traffic Flow
Dynamics*, Springer, chapter 4).

Shapes: P pairs, T frames, K ranges of speed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from torch import Tensor

    from cfx.data.pairs import PairBatch, PairSet

__all__ = [
    "EDGES_MPS",
    "VEHICLE_M",
    "GapRelation",
    "SteadyFollowing",
    "flow",
    "relation_from",
    "relation_of",
    "relations_of_types",
    "steady_following",
]
"""What plugins may use, as `cfx.plugin.steady`."""

EDGES_MPS = (0.5, 3.0, 6.0, 9.0, 12.0, 16.0, 20.0, 25.0, 30.0, 40.0)
"""m/s: the ranges of speed in which gaps are averaged, wider where recordings are fewer."""

VEHICLE_M = 4.8
"""m: length of a vehicle where flows are computed from gaps."""

RELATIVE_SPEED_MPS = 0.5
ACCELERATION_MPS2 = 0.4
"""A driver follows steadily in a frame in which both are smaller, whatever their sign."""

LEAST_S = 3.0
"""s: a pair counts in a range of speed if it follows steadily there for this long, in all."""

Floats = NDArray[np.float64]


class SteadyFollowing(NamedTuple):
    """Mean steady following of each pair in each range of speed, `(P, K)` each.

    Attributes:
        speed: mean speed, m/s.
        gap: mean gap, bumper to bumper, m. Speed and gap are NaN where a pair followed steadily for
            less than `LEAST_S`.
        seconds: for how long each pair followed steadily in each range.
    """

    speed: Tensor
    gap: Tensor
    seconds: Tensor


class GapRelation(NamedTuple):
    """The gap that drivers keep, by speed: a row for each range with enough of them, `(K,)` each.

    Attributes:
        speed: mean speed of the drivers in the range, m/s.
        gap: mean time headway times that speed, minus a vehicle's length: the gap, bumper to
            bumper, of a lane that holds all these drivers, m.
        low, median, high: quartiles of the gaps that drivers keep at that speed, each at their own
            time headway, m.
        drivers: how many drivers the range has.
    """

    speed: Floats
    gap: Floats
    low: Floats
    median: Floats
    high: Floats
    drivers: NDArray[np.int64]

    def columns(self) -> dict[str, list[float]]:
        """Returns the columns as lists of numbers."""
        return {name: np.round(getattr(self, name), 3).tolist() for name in self._fields}

    def gap_at(self, speed: Floats) -> Floats:
        """Returns the gap at the mean time headway, m; NaN outside of the recorded speeds."""
        if not len(self.speed):
            return np.full_like(speed, np.nan)
        return np.interp(speed, self.speed, self.gap, left=np.nan, right=np.nan)


def flow(speed: Floats, gap: Floats) -> Floats:
    """Returns the flow of a lane, vehicles/h, in which all keep one speed, m/s, and one gap, m."""
    return 3600.0 * speed / (gap + VEHICLE_M)


def steady_following(batch: PairBatch, counted: Tensor | None = None) -> SteadyFollowing:
    """Averages the steady following of each pair.

    Args:
        batch: P pairs.
        counted: which frames may be used, bool `(P, T)`; None: all.
    """
    import torch

    speed, gap = batch.follower_speed, batch.gap
    is_steady = batch.mask & ((batch.leader_speed - speed).abs() < RELATIVE_SPEED_MPS)
    is_steady &= batch.follower_acceleration.abs() < ACCELERATION_MPS2
    if counted is not None:
        is_steady &= counted
    edges = torch.tensor(EDGES_MPS, dtype=speed.dtype, device=speed.device)
    speed_range = torch.bucketize(speed, edges, right=True) - 1
    is_steady &= (speed_range >= 0) & (speed_range < len(edges) - 1)
    speed_range = speed_range.clamp(0, len(edges) - 2)  # what is outside has the weight 0
    weight = is_steady.to(torch.float64)
    sums = []
    for values in (weight, weight * speed.double(), weight * gap.double()):
        total = weight.new_zeros((len(batch), len(edges) - 1))
        sums.append(total.scatter_add_(1, speed_range, values))
    frames = sums[0]
    is_long = frames * batch.dt >= LEAST_S
    means = []
    for total in sums[1:]:
        means.append(torch.where(is_long, total / frames.clamp(min=1.0), torch.nan))
    return SteadyFollowing(means[0], means[1], frames * batch.dt)


def relation_of(
    following: SteadyFollowing, drivers: Sequence[str], weight: Floats | None = None, least: int = 3
) -> GapRelation:
    """Returns the relation of speed and gap of some drivers.

    Within a range of speed the faster drivers have the larger gaps. Time headways (front to front,
    the spacing over the speed) hardly depend on speed there, so quartiles and means are taken over
    them, and become gaps at the range's mean speed.

    Args:
        following: of P pairs.
        drivers: whose pair each is; all pairs of a driver together count once.
        weight: of each pair, `(P,)`; None: all drivers alike.
        least: drivers that a range needs to be listed.
    """
    speeds, gaps = following.speed.cpu().numpy(), following.gap.cpu().numpy()
    _, driver = np.unique(np.asarray(drivers), return_inverse=True)
    shares = 1.0 / np.bincount(driver)[driver] if weight is None else weight
    rows: list[tuple[float, ...]] = []
    for speed_range in range(speeds.shape[1]):
        measured = np.isfinite(speeds[:, speed_range])
        count_of_drivers = len(np.unique(driver[measured]))
        if count_of_drivers < max(1, least):
            continue
        speeds_there, gaps_there = speeds[measured, speed_range], gaps[measured, speed_range]
        mean_speed = float(np.average(speeds_there, weights=shares[measured]))
        headway = (gaps_there + VEHICLE_M) / speeds_there
        quartiles = np.quantile(
            headway, (0.25, 0.5, 0.75), method="inverted_cdf", weights=shares[measured]
        )
        mean = float(np.average(headway, weights=shares[measured]))
        # A lane's flow is 1 / (mean time headway), which no mean of gaps would give.
        gaps_of_headways = np.array([mean, *quartiles]) * mean_speed - VEHICLE_M
        rows.append((mean_speed, *gaps_of_headways.tolist(), count_of_drivers))
    speed, gap, low, median, high, count = np.array(rows, dtype=np.float64).reshape(-1, 6).T
    return GapRelation(speed, gap, low, median, high, count.astype(np.int64))


def relations_of_types(pairs: PairSet) -> dict[str, GapRelation]:
    """Returns the relation of speed and gap of each type of driver.

    Args:
        pairs: recordings of people, of cars with adaptive cruise control, or of both; a type has
            the name that they give it, "" where they say nothing.
    """
    from cfx.data.pairs import PairBatch, of_each

    following = steady_following(PairBatch.of(pairs))
    drivers = np.array(pairs.drivers, dtype=object)
    types = np.array(of_each(pairs, "driver_type"), dtype=object)
    relations = {}
    for driver_type in np.unique(types).tolist():
        rows = np.flatnonzero(types == driver_type)
        of_type = SteadyFollowing(*(values[rows] for values in following))
        relations[driver_type] = relation_of(of_type, drivers[rows].tolist())
    return relations


def relation_from(table: Mapping[str, Sequence[float]]) -> GapRelation:
    """Returns a relation from its columns, as `GapRelation.columns` gives them.

    Raises:
        KeyError: a column is missing.
    """
    return GapRelation(
        speed=np.asarray(table["speed"], dtype=np.float64),
        gap=np.asarray(table["gap"], dtype=np.float64),
        low=np.asarray(table["low"], dtype=np.float64),
        median=np.asarray(table["median"], dtype=np.float64),
        high=np.asarray(table["high"], dtype=np.float64),
        drivers=np.asarray(table["drivers"], dtype=np.int64),
    )
