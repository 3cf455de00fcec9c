"""Position, speed, acceleration, gap and time of a pair must tell the same story.

A signal must change as the integral of its rate says: positions as speeds, speeds as accelerations,
the gap as the relative speed. For each pair the slope of the one on the other is measured; it is 1
where all are in the units that they should be in. Integrals are compared, not differences of
neighbouring frames, in which noise drowns everything; the gap over windows of `_WINDOW_S`, because
a small bias of a speed adds up over minutes.

A slope is judged only where the signal changes enough, and both go together, for it to say
something (`_Rule`). What agrees with itself cannot be seen: a pair all of whose signals are in feet
is a pair of fast vehicles far apart.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from cfx.core.errors import DataError
from cfx.data.files import Floats
from cfx.data.pairs import Pair, PairSet

log = logging.getLogger(__name__)

Check = Literal["refuse", "report", "off"]

_WINDOW_S = 5.0
_SHOWN = 3
"""Pairs that a message names."""

_SAME = 0.08
"""How far a measured factor may be from one that is known."""


@dataclass(frozen=True)
class _Rule:
    """Rule of a slope: when it is checked, and its bounds.

    The bounds leave room for all pairs of the recordings that cfx was tried on; docs/readers.md
    has their slopes.

    Attributes:
        spread: of `Slope` at least, in the signal's unit.
        correlation: of signal and integral at least, without its sign.
        low, high: bounds of the slope.
    """

    spread: float
    correlation: float
    low: float
    high: float


_POSITION = _Rule(spread=10.0, correlation=0.9, low=0.84, high=1.19)
_SPEED = _Rule(spread=0.5, correlation=0.8, low=0.8, high=1.25)
_GAP = _Rule(spread=1.0, correlation=0.9, low=0.6, high=1.65)

_POSITION_FACTORS = {
    1 / 0.3048: "the positions look like feet; multiply them by 0.3048",
    0.3048: "the speeds look like feet per second; multiply them by 0.3048",
    1 / 3.6: "the speeds look like km/h; divide them by 3.6",
    0.44704: "the speeds look like miles per hour; multiply them by 0.44704",
    1000.0: "the positions look like millimetres or the speeds like km/s; write m and m/s",
    100.0: "the positions look like centimetres; divide them by 100",
    0.001: "the times look like milliseconds, or the positions like kilometres; write s and m",
}
_SPEED_FACTORS = {
    9.80665: "they look like multiples of g; multiply them by 9.81",
    10.0: "they are 0.1 times what the speeds say; write m/s2",
    0.3048: "they look like ft/s2; multiply them by 0.3048",
    1 / 3.6: "they look like km/h per second; divide them by 3.6",
    -1.0: "their sign is turned; braking is negative",
}
_GAP_FACTORS = {
    1 / 0.3048: "the gaps look like feet; multiply them by 0.3048",
    0.3048: "the speeds look like feet per second; multiply them by 0.3048",
    1 / 3.6: "the speeds look like km/h; divide them by 3.6",
    0.44704: "the speeds look like miles per hour; multiply them by 0.44704",
}


@dataclass(frozen=True)
class Slope:
    """Slope of one signal against the integral of its rate.

    Attributes:
        slope: change of the signal over that of the integral, with the sign of their correlation.
        correlation: -1 to 1.
        spread: standard deviation of the signal or of the integral, whichever is larger, in the
            signal's unit.
    """

    slope: float
    correlation: float
    spread: float

    def judged(self, rule: _Rule) -> float | None:
        """Returns the slope; None where it says nothing."""
        if self.spread < rule.spread or abs(self.correlation) < rule.correlation:
            return None
        return self.slope


def slope_of(values: Floats, rates: Floats, dt: float, window: int | None = None) -> Slope:
    """Measures the slope of a signal on the integral of its rate.

    Args:
        values: the signal, `(T,)`.
        rates: its rate, `(T,)`, per second.
        dt: time step, s.
        window: frames over which changes are compared; None: the whole.
    """
    x = np.concatenate([[0.0], np.cumsum(0.5 * (rates[1:] + rates[:-1]) * dt)])
    y = values
    if window is not None and len(values) > window:
        x, y = x[window:] - x[:-window], y[window:] - y[:-window]
    x, y = x - np.median(x), y - np.median(y)
    of_x, of_y = math.sqrt(float(np.mean(x * x))), math.sqrt(float(np.mean(y * y)))
    if of_x == 0 or of_y == 0:
        return Slope(math.nan, 0.0, max(of_x, of_y))
    correlation = float(np.mean(x * y)) / (of_x * of_y)
    return Slope(math.copysign(of_y / of_x, correlation), correlation, max(of_x, of_y))


def contradiction(pair: Pair) -> str | None:
    """Returns what of a pair contradicts what, and why probably; None if nothing does."""
    for who in ("leader", "follower"):
        speeds: Floats = getattr(pair, f"{who}_speed")
        position = slope_of(getattr(pair, f"{who}_position"), speeds, pair.dt).judged(_POSITION)
        of_speed = slope_of(speeds, getattr(pair, f"{who}_acceleration"), pair.dt)
        speed = of_speed.judged(_SPEED)
        if position is not None and not _POSITION.low <= position <= _POSITION.high:
            return (
                f"{who}_position and {who}_speed: the distance driven is {position:.3g} times speed"
                f" times time: {_why_position(position, speed, pair.dt)}"
            )
        if speed is not None and not _SPEED.low <= speed <= _SPEED.high:
            reason = _named(speed, _SPEED_FACTORS)
            if reason is None:
                reason = f"they are {1 / speed:.3g} times what the speeds say; write m/s2"
            return (
                f"{who}_speed and {who}_acceleration: speeds change {speed:.3g} times as much as"
                f" the accelerations say: {reason}"
            )
        if of_speed.spread >= 2 * _SPEED.spread and abs(of_speed.correlation) < 0.5:
            return (
                f"{who}_speed and {who}_acceleration: speeds do not change as the accelerations"
                f" say (correlation {of_speed.correlation:.2f}): are they of this vehicle, at this"
                " time?"
            )
    relative = pair.leader_speed - pair.follower_speed
    window = max(1, round(_WINDOW_S / pair.dt))
    gap = slope_of(pair.gap, relative, pair.dt, window).judged(_GAP)
    if gap is not None and not _GAP.low <= gap <= _GAP.high:
        reason = _named(gap, _GAP_FACTORS, 0.15)
        return (
            f"gap and speeds: the gap changes {gap:.3g} times as the relative speed says:"
            f" {reason or 'gaps must be in m, speeds in m/s'}"
        )
    return None


def _why_position(position: float, speed: float | None, dt: float) -> str:
    """Returns why a distance is not speed times time, from that and the slope of the speed."""
    if position < 0:
        return "positions must grow along the lane"
    if speed is not None and abs(speed / position - 1) < _SAME:
        return (
            f"speeds change as much faster than the accelerations say, so the time step looks like"
            f" {position * dt:.3g} s, not {dt:.3g} s"
        )
    reason = _named(position, _POSITION_FACTORS)
    return reason or "positions must be in m, speeds in m/s and times in s"


def _named(factor: float, known: dict[float, str], room: float = _SAME) -> str | None:
    """Returns what is known of the nearest factor, if it is near."""
    nearest = min(known, key=lambda one: abs(factor / one - 1))
    if abs(factor / nearest - 1) < room:
        return known[nearest]
    return None


def contradictions(pairs: PairSet) -> Iterator[tuple[str, str]]:
    """Yields the id of each pair that contradicts itself, and how."""
    for pair in pairs:
        how = contradiction(pair)
        if how is not None:
            yield pair.pair_id, how


def in_words(pairs: PairSet) -> str:
    """Returns which pairs contradict themselves, how and what to do; "" if none does."""
    found = list(contradictions(pairs))
    if not found:
        return ""
    named = "; ".join(f"pair '{name}': {how}" for name, how in found[:_SHOWN])
    count = f"{len(found)} of {len(pairs)} pairs contradict themselves"
    if len(found) == 1:
        count = f"one of {len(pairs)} pairs contradicts itself"
    more = f" (and {len(found) - _SHOWN} more)" if len(found) > _SHOWN else ""
    return f"{pairs.source}: {count}: {named}{more}"


def check_kinematics(pairs: PairSet, check: Check) -> None:
    """Refuses or reports pairs that contradict themselves, as `data.check` says.

    Raises:
        DataError: `check` is `refuse`, and some do.
    """
    if check == "off":
        return
    words = in_words(pairs)
    if words and check == "refuse":
        raise DataError(
            f"{words}; correct the file, leave these pairs out, or say data.check=report to go on"
        )
    if words:
        log.warning("%s (data.check=report)", words)
