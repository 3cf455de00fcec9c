"""Driver features: what a driver's measured past tells of him, in a few numbers that a policy knows from its first window on.

A network that has to find out from its memory what sort of driver it imitates finds little in the end, and a driver's own fixed
parameters tell it only as much as one minute determines them: of Wiedemann 99's ten hardly any. How far behind he keeps, how much
his speed differs from his leader's, how hard he accelerates and how late he reacts can simply be measured. On the I-80 recordings
his mean time headway of the first half of a drive correlates with that of the second by 0.76, the other driver features by 0.4 to 0.6.

Shapes: P pairs, T frames, k driver features.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from cfx.pairs import PairBatch
from cfx.policies.features import History, check_names, of_set

MOVING = 2.0
"""m/s: frames in which the follower is slower say nothing of his time headway."""

LEAST = 15.0
"""s: who was measured for less while moving is unknown."""

_ACCURACY = 0.05
"""m/s and m/s2: added to a spread before its logarithm, which would make much of differences below it."""

_FLAT = 2.0
"""(m/s)2: weight of `_USUAL_GAP` in a regression of the gap on a speed that hardly varies."""

_USUAL_GAP = 1.2
"""s: by how much the gap grows with speed for a driver whose speed has not varied."""

_DELAYS = 0.2, 4.0
"""s: step and largest of the delays among which a driver's response time is sought."""

_CLEARLY = 0.05, 0.1
"""(m/s)2, and as a share of the least variance: delays whose variance exceeds the least by as much weigh 1/e of it."""


class Measured(NamedTuple):
    """Stretches of P drives.

    Attributes:
        signals: `(P, T)` each, SI units.
        counted: which frames belong to the stretch, bool `(P, T)`.
        dt: time step, s.
    """

    signals: History
    counted: Tensor
    dt: float

    @property
    def moving(self) -> Tensor:
        """The frames of the stretch in which the follower moves, `(P, T)`."""
        return self.counted & (self.signals.follower_speed > MOVING)


def _mean(values: Tensor, counted: Tensor) -> Tensor:
    """Returns the mean of each pair `(P,)` over the frames that count, both `(P, T)`; 0 where none does."""
    return torch.where(counted, values, 0.0).sum(1) / counted.sum(1).clamp(min=1)


def _log_rms(values: Tensor, counted: Tensor) -> Tensor:
    return torch.log(_mean(values.square(), counted).sqrt() + _ACCURACY)


def _time_headway(m: Measured) -> Tensor:
    """The mean logarithm of gap (m) over speed (m/s)."""
    headway = m.signals.gap.clamp(min=0.5) / m.signals.follower_speed.clamp(min=MOVING)
    return _mean(headway.log(), m.moving)


def _time_gap(m: Measured) -> Tensor:
    """By how much the gap grows with speed, s: a ridge regression around what is usual, as speed may hardly have varied."""
    speed, gap = (
        values - _mean(values, m.counted)[:, None]
        for values in (m.signals.follower_speed, m.signals.gap)
    )
    return (_mean(speed * gap, m.counted) + _FLAT * _USUAL_GAP) / (
        _mean(speed.square(), m.counted) + _FLAT
    )


def _standstill_gap(m: Measured) -> Tensor:
    """What gap that regression leaves at standstill, m."""
    return _mean(m.signals.gap, m.counted) - _time_gap(m) * _mean(
        m.signals.follower_speed, m.counted
    )


def _speed_difference(m: Measured) -> Tensor:
    """The logarithm of the root mean square of the difference to the leader's speed, m/s."""
    return _log_rms(m.signals.leader_speed - m.signals.follower_speed, m.counted)


def _acceleration(m: Measured) -> Tensor:
    """The logarithm of the root mean square acceleration, m/s2."""
    return _log_rms(m.signals.follower_acceleration, m.counted)


def _response_time(m: Measured) -> Tensor:
    """How long after his leader he does the same, s: the mean of delays, weighted by how little their speeds then differ."""
    first, most = (max(1, round(delay / m.dt)) for delay in _DELAYS)
    delays = range(0, min(most, m.counted.shape[1] - 1) + 1, first)
    variances = []
    for delay in delays:
        both = m.counted[:, delay:] & m.counted[:, : m.counted.shape[1] - delay]
        apart = (
            m.signals.follower_speed[:, delay:]
            - m.signals.leader_speed[:, : m.counted.shape[1] - delay]
        )
        variances.append(_mean((apart - _mean(apart, both)[:, None]).square(), both))
    variance = torch.stack(variances, 1)
    least = variance.min(1, keepdim=True).values
    weight = torch.softmax(-(variance - least) / (_CLEARLY[0] + _CLEARLY[1] * least), 1)
    return weight @ torch.tensor(
        [delay * m.dt for delay in delays], dtype=weight.dtype, device=weight.device
    )


DRIVER_FEATURES: dict[str, Callable[[Measured], Tensor]] = {
    "time_headway": _time_headway,
    "time_gap": _time_gap,
    "standstill_gap": _standstill_gap,
    "speed_difference": _speed_difference,
    "acceleration": _acceleration,
    "response_time": _response_time,
}
"""Driver features that a policy may know, each `(P,)`. What does not hold from the first half of a drive to the second tells nothing of a
driver: the spread of his headway, say, or how many times as hard as his leader he accelerates (correlations of 0.15 and 0.1)."""

DRIVER_FEATURE_SETS: dict[str, tuple[str, ...]] = {"all": tuple(DRIVER_FEATURES), "none": ()}
"""Driver features that go by one name: `policy.driver_features=all`."""


def named_driver_features(value: object) -> object:
    """As `of_set`, for driver features."""
    return of_set(value, DRIVER_FEATURE_SETS, DRIVER_FEATURES, "driver feature")


def check_driver_features(names: Sequence[str]) -> None:
    """As `check_names`, for driver features."""
    check_names(names, DRIVER_FEATURES, "driver feature")


def measure(
    batch: PairBatch, names: Sequence[str], dt: float, since: Tensor, until: Tensor
) -> Tensor:
    """Measures drivers' driver features.

    Args:
        batch: P pairs.
        names: the driver features, k of `TRAITS`.
        dt: the pairs' time step, s.
        since, until: `(P,)`, the frames from which on and before which each driver is measured.

    Returns:
        `(P, k)` float64; NaN for a driver who moved for less than `LEAST` seconds of that.
    """
    frame = torch.arange(batch.mask.shape[1], device=until.device)
    counted = batch.mask & (frame >= since[:, None]) & (frame < until[:, None])
    measured = Measured(History(*(signal.double() for signal in History.of(batch))), counted, dt)
    known = measured.moving.sum(1) * dt >= LEAST
    return torch.where(
        known[:, None],
        torch.stack([DRIVER_FEATURES[name](measured) for name in names], -1),
        torch.nan,
    )
