"""Driver features: a few numbers measured from a driver's history.

A policy knows them from its first window on. A network that has to find out from its memory how a
driver drives finds little in the end. Driver-specific parameters say only as much as one minute of
driving determines: of Wiedemann 99's ten hardly any. How far behind a driver stays, how much their
speed differs from their leader's, how hard they accelerate and how late they react can be measured.
On the I-80 recordings the mean time headway of the first half of a trajectory correlates with that
of the second by 0.76, the other driver features by 0.4 to 0.6.

Training measures them on full trajectories, a test on what came before it: networks whose features
came from the part before each training trajectory alone learned less from them.

Shapes: P pairs, T frames, k driver features.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from cfx.data.pairs import PairBatch
from cfx.policies.history import History, changed, history_of

MOVING = 2.0
"""m/s: frames in which the follower is slower say nothing of their time headway."""

LEAST = 15.0
"""s: a driver who was measured for less while moving is unknown."""

_LEAST_GAP = 0.5
"""m: gaps below it count as this, so that the time headway has a logarithm."""

_ACCURACY = 0.05
"""m/s and m/s2: added to an RMS before its logarithm, so that differences below it do not
matter."""

_FLAT = 2.0
"""(m/s)2: weight of `_USUAL_GAP` in a regression of the gap on a speed that hardly varies."""

_USUAL_GAP = 1.2
"""s: by how much the gap grows with speed for a driver whose speed has not varied."""

_DELAY_STEP, _LONGEST_DELAY = 0.2, 4.0
"""s: the delays among which a driver's response time is sought."""

_CLEARLY, _CLEARLY_SHARE = 0.05, 0.1
"""(m/s)2, and as a share of the least variance: a delay whose variance exceeds the least by as much
weighs 1/e of it."""


class TrajectoryPart(NamedTuple):
    """Parts of P trajectories.

    Attributes:
        signals: `(P, T)` each, SI units.
        counted: which frames belong to the part, bool `(P, T)`.
        dt: time step, s.
    """

    signals: History
    counted: Tensor
    dt: float

    @property
    def moving(self) -> Tensor:
        """The frames of the part in which the follower moves, bool `(P, T)`."""
        return self.counted & (self.signals["follower_speed"] > MOVING)


def _mean(values: Tensor, counted: Tensor) -> Tensor:
    """Returns the mean of each pair `(P,)` over the frames that count; 0 where none does."""
    return torch.where(counted, values, 0.0).sum(1) / counted.sum(1).clamp(min=1)


def _log_rms(values: Tensor, counted: Tensor) -> Tensor:
    return torch.log(_mean(values.square(), counted).sqrt() + _ACCURACY)


def _time_headway(part: TrajectoryPart) -> Tensor:
    """The mean logarithm of gap (m) over speed (m/s)."""
    speed = part.signals["follower_speed"].clamp(min=MOVING)
    headway = part.signals["gap"].clamp(min=_LEAST_GAP) / speed
    return _mean(headway.log(), part.moving)


def _time_gap(part: TrajectoryPart) -> Tensor:
    """By how much the gap grows with speed, s: ridge regression, as speed may hardly vary."""
    speed = part.signals["follower_speed"]
    speed = speed - _mean(speed, part.counted)[:, None]
    gap = part.signals["gap"]
    gap = gap - _mean(gap, part.counted)[:, None]
    covariance = _mean(speed * gap, part.counted)
    variance = _mean(speed.square(), part.counted)
    return (covariance + _FLAT * _USUAL_GAP) / (variance + _FLAT)


def _standstill_gap(part: TrajectoryPart) -> Tensor:
    """The gap that this regression leaves at standstill, m."""
    speed = _mean(part.signals["follower_speed"], part.counted)
    return _mean(part.signals["gap"], part.counted) - _time_gap(part) * speed


def _speed_difference(part: TrajectoryPart) -> Tensor:
    """The logarithm of the root mean square of the difference to the leader's speed, m/s."""
    return _log_rms(part.signals["leader_speed"] - part.signals["follower_speed"], part.counted)


def _acceleration(part: TrajectoryPart) -> Tensor:
    """The logarithm of the root mean square acceleration, m/s2."""
    return _log_rms(part.signals["follower_acceleration"], part.counted)


def _response_time(part: TrajectoryPart) -> Tensor:
    """How long after their leader a driver does the same, s.

    The mean of delays, weighted by how little the delayed speeds differ.
    """
    step = max(1, round(_DELAY_STEP / part.dt))
    longest = max(1, round(_LONGEST_DELAY / part.dt))
    frames = part.counted.shape[1]
    delays = range(0, min(longest, frames - 1) + 1, step)
    variances = []
    for delay in delays:
        both = part.counted[:, delay:] & part.counted[:, : frames - delay]
        leader = part.signals["leader_speed"][:, : frames - delay]
        apart = part.signals["follower_speed"][:, delay:] - leader
        variances.append(_mean((apart - _mean(apart, both)[:, None]).square(), both))
    variance = torch.stack(variances, 1)
    least = variance.min(1, keepdim=True).values
    weight = torch.softmax(-(variance - least) / (_CLEARLY + _CLEARLY_SHARE * least), 1)
    seconds = [delay * part.dt for delay in delays]
    return weight @ torch.tensor(seconds, dtype=weight.dtype, device=weight.device)


DRIVER_FEATURES: dict[str, Callable[[TrajectoryPart], Tensor]] = {
    "time_headway": _time_headway,
    "time_gap": _time_gap,
    "standstill_gap": _standstill_gap,
    "speed_difference": _speed_difference,
    "acceleration": _acceleration,
    "response_time": _response_time,
}
"""Driver features that a policy may know, each `(P,)`. A quantity that does not hold from the first
half of a trajectory to the second says nothing of a driver: the standard deviation of the headway,
for instance, or acceleration relative to the leader's (correlations of 0.15 and 0.1)."""

DRIVER_FEATURE_SETS: dict[str, tuple[str, ...]] = {"all": tuple(DRIVER_FEATURES), "none": ()}
"""Driver features that go by one name: `policy.driver_features=all`."""


def measure(
    batch: PairBatch, names: Sequence[str], dt: float, since: Tensor, until: Tensor
) -> Tensor:
    """Measures driver features.

    Args:
        batch: P pairs.
        names: the driver features, k of `DRIVER_FEATURES`.
        dt: the pairs' time step, s.
        since, until: `(P,)`, the frames from which on and before which each driver is measured.

    Returns:
        `(P, k)` float64; NaN for a driver who moved for less than `LEAST` seconds of that.
    """
    frame = torch.arange(batch.mask.shape[1], device=until.device)
    in_part = batch.mask & (frame >= since[:, None]) & (frame < until[:, None])
    part = TrajectoryPart(changed(history_of(batch), torch.Tensor.double), in_part, dt)
    values = torch.stack([DRIVER_FEATURES[name](part) for name in names], -1)
    is_known = part.moving.sum(1) * dt >= LEAST
    return torch.where(is_known[:, None], values, torch.nan)
