"""Replaces noisy accelerations.

Many recordings have accelerations that are differences of rounded or noisy speeds: between two
frames they change by more than any car's does. Policies read accelerations and start with the
driver's acceleration and jerk, so noise there makes jolts. The replacement is an exponential
average of the past, smoothed twice so that it has a jerk too (R. G. Brown 1959, Statistical
forecasting for inventory control), with the time constant that best predicts the change of speed,
times the coefficient of that regression.

Coefficient and average are rounded to `_DECIMALS`: the last bits of a dot product depend on the
processor (OpenBLAS has a kernel for each), and a recording must have one fingerprint everywhere.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np
import pandas as pd

from cfx.data.files import Floats
from cfx.data.pairs import Pair, PairSet

log = logging.getLogger(__name__)

Accelerations = Literal["smooth", "recorded"]
"""Whether noisy accelerations are smoothed: `data.accelerations`."""

TIME_CONSTANTS_S = (0.2, 0.3, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0)
"""Among which the best is chosen."""

_AHEAD_S = 1.0
"""How far ahead accelerations are to tell the speed."""

_JERK_TIME_S, _MOST_JERK = 0.8, 5.0
"""How a jerk is forgotten, and its bound, m/s3: as policies start (`cfx.models.composed`)."""

_LOOKED_AT_S = 60.0
"""Beginning of a pair from which the average is chosen."""

_LEAST_S = 5.0
"""A shorter pair is left as it is."""

_DECIMALS = 6
"""Of what is computed here: far finer than any recording, far coarser than rounding errors."""

_NOTHING = 1e-12
"""(m/s)2; below it nothing is divided by."""

_WORTH = 0.9
"""Squared errors of the average below this share of the recorded one's are worth it."""


class Average(NamedTuple):
    """Exponential average, applied twice, that replaces recorded accelerations.

    Attributes:
        constant: time constant of each of the two averages, s; 0: as recorded.
        factor: how much of the average the speed follows, 0 to 1.
    """

    constant: float
    factor: float

    def of(self, values: Floats, dt: float) -> Floats:
        """Returns the average of values `(T,)` at each frame, of its past alone; `dt` in s."""
        if self.constant == 0:
            return values
        return np.round(self.factor * smoothed_twice(values, self.constant, dt), _DECIMALS)


RECORDED = Average(0.0, 1.0)
"""No averaging: the recorded values."""


def with_usable_accelerations(pairs: PairSet, how: Accelerations) -> PairSet:
    """Replaces accelerations that predict the speed worse than their moving average does.

    Leader and follower are judged each on their own; speeds and positions stay as they are.

    Args:
        pairs: as recorded.
        how: `recorded` changes nothing.
    """
    if how == "recorded":
        return pairs
    changed, constants = averaged(pairs)
    if not constants:
        return pairs
    log.info(
        "Accelerations of %d of %d pairs are noisy: averages of their past (time constants of %g to"
        " %g s) stand for them; data.accelerations=recorded keeps them",
        len(constants),
        len(pairs),
        min(constants),
        max(constants),
    )
    return changed


def averaged(pairs: PairSet) -> tuple[PairSet, list[float]]:
    """Replaces noisy accelerations, and says of each changed pair over how long it averages, s."""
    constants: list[float] = []

    def change(pair: Pair) -> Pair:
        of_follower = best_average(pair.follower_speed, pair.follower_acceleration, pair.dt)
        of_leader = best_average(pair.leader_speed, pair.leader_acceleration, pair.dt)
        if of_follower == of_leader == RECORDED:
            return pair
        constants.append(max(of_follower.constant, of_leader.constant))
        return replace(
            pair,
            follower_acceleration=of_follower.of(pair.follower_acceleration, pair.dt),
            leader_acceleration=of_leader.of(pair.leader_acceleration, pair.dt),
        )

    return pairs.changed(change), constants


def best_average(speed: Floats, acceleration: Floats, dt: float) -> Average:
    """Returns the average of accelerations that best predicts the change of speed.

    It is `RECORDED` where the acceleration as recorded tells as much, or where there is too little
    to say.

    Args:
        speed: `(T,)`, m/s.
        acceleration: `(T,)`, m/s2.
        dt: time step, s.
    """
    frames = min(len(speed), round(_LOOKED_AT_S / dt))
    ahead = max(1, round(_AHEAD_S / dt))
    if len(speed) * dt < _LEAST_S or dt >= _AHEAD_S:
        return RECORDED
    acceleration = acceleration[:frames]
    follows = speed[ahead:frames] - speed[: frames - ahead]
    lasts = ahead * dt
    jerk_lasts = _JERK_TIME_S * (lasts + _JERK_TIME_S * np.expm1(-lasts / _JERK_TIME_S))

    def judged(constant: float) -> tuple[float, Average]:
        values = Average(constant, 1.0).of(acceleration, dt)
        jerk = np.clip(np.diff(values, prepend=values[0]) / dt, -_MOST_JERK, _MOST_JERK)
        expected = (values * lasts + jerk * jerk_lasts)[: frames - ahead]
        factor = 1.0
        if constant > 0:
            scale = max(float(expected @ expected), _NOTHING)
            factor = round(min(1.0, max(0.0, float(follows @ expected) / scale)), _DECIMALS)
        error = float(np.square(follows - factor * expected).mean())
        return error, Average(constant, factor)

    recorded, _ = judged(0.0)
    error, best = min([judged(constant) for constant in TIME_CONSTANTS_S])
    if error < _WORTH * recorded:
        return best
    return RECORDED


def smoothed_twice(values: Floats, constant: float, dt: float) -> Floats:
    """Returns the exponential average of the exponential average, `(T,)`, of the past alone.

    Args:
        values: `(T,)`; the first stands for those before it.
        constant: time constant of both, s.
        dt: time step, s.
    """
    share = -np.expm1(-dt / constant)
    average = pd.Series(values)
    for _ in range(2):
        average = average.ewm(alpha=share, adjust=False).mean()
    return np.asarray(average, np.float64)
