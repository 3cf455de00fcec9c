"""Position, speed, acceleration, gap and time of a pair must tell the same story.

A signal must change as the integral of its rate says: positions as speeds, speeds as accelerations,
the gap as the relative speed. For each pair the slope of the one on the other is measured; it is 1
where all are in the units that they should be in. Integrals are compared, not differences of
neighbouring frames, in which noise drowns everything; the gap over windows of `_WINDOW_S`, because
a small bias of a speed adds up over minutes.

A slope is judged only where the signal changes enough, and both go together, for it to say
something (`_Rule`). Noise and drift leave a pair much room; the median over many pairs has little
(`_TYPICAL`), so that km/h are told from ft/s. What agrees with itself cannot be seen: a pair all of
whose signals are in feet is a pair of fast vehicles far apart.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from cfx.core.errors import DataError
from cfx.data.files import Floats
from cfx.data.pairs import Pair, PairSet
from cfx.data.units import factor

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

_TYPICAL = {"position": (0.96, 1.04), "gap": (0.8, 1.25)}
"""Bounds of the median of slopes over `_MANY` pairs or more; docs/readers.md has medians."""

_MANY = 4

_SI = {"position": "m", "speed": "m/s", "acceleration": "m/s2", "gap": "m", "time": "s"}

_LIKELY = {
    "position": ("m", "ft", "cm", "mm", "km"),
    "gap": ("m", "ft"),
    "speed": ("m/s", "km/h", "ft/s", "mph"),
    "time": ("s", "ms"),
    "acceleration": ("m/s2", "g_0", "ft/s2", "km/h/s"),
}
"""Units in which recordings have a quantity; more would be taken for one another."""

_ACCELERATION_FACTORS = {
    10.0: "they are 0.1 times what the speeds say; write m/s2",
    -1.0: "their sign is turned; braking is negative",
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


Units = Mapping[str, str]
"""Units that a file is said to have in place of SI units, by `Dataset.units`'s names."""


def contradiction(pair: Pair, units: Units | None = None) -> str | None:
    """Returns what of a pair contradicts what, and why probably; None if nothing does.

    Args:
        units: those that its file is said to have; its signals are in SI units.
    """
    for who in ("leader", "follower"):
        own = _units_of(who, units or {})
        speeds: Floats = getattr(pair, f"{who}_speed")
        position = slope_of(getattr(pair, f"{who}_position"), speeds, pair.dt).judged(_POSITION)
        of_speed = slope_of(speeds, getattr(pair, f"{who}_acceleration"), pair.dt)
        speed = of_speed.judged(_SPEED)
        if position is not None and not _POSITION.low <= position <= _POSITION.high:
            return (
                f"{who}_position and {who}_speed: the distance driven is {position:.3g} times speed"
                f" times time: {_why_position(position, speed, pair.dt, own)}"
            )
        if speed is not None and not _SPEED.low <= speed <= _SPEED.high:
            known = _ACCELERATION_FACTORS | _factors(own, faster=("acceleration",))
            reason = _named(speed, known)
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
    gap = _gap_slope(pair)
    if gap is not None and not _GAP.low <= gap <= _GAP.high:
        return f"gap and speeds: {_why_gap(gap, units or {})}"
    return None


def _gap_slope(pair: Pair) -> float | None:
    """Returns the slope of the gap on the integral of the relative speed; None: it says nothing."""
    relative = pair.leader_speed - pair.follower_speed
    window = max(1, round(_WINDOW_S / pair.dt))
    return slope_of(pair.gap, relative, pair.dt, window).judged(_GAP)


def _position_slopes(pair: Pair) -> list[float]:
    """Returns the slopes of both vehicles' positions that say something."""
    found = []
    for who in ("leader", "follower"):
        position, speed = getattr(pair, f"{who}_position"), getattr(pair, f"{who}_speed")
        slope = slope_of(position, speed, pair.dt).judged(_POSITION)
        if slope is not None:
            found.append(slope)
    return found


def typical_contradiction(pairs: PairSet, units: Units | None = None) -> str | None:
    """Returns what contradicts what over all pairs together, and why; None if nothing does.

    Pairs in time steps of their own are compared too: a slope has no unit.
    """
    own = _units_of("follower", units or {})
    positions: list[float] = []
    gaps: list[float] = []
    for pair in pairs:
        positions += _position_slopes(pair)
        gap = _gap_slope(pair)
        if gap is not None:
            gaps.append(gap)
    slope = _beyond(positions, "position")
    if slope is not None:
        return (
            f"the distance driven is typically {slope:.3g} times speed times time:"
            f" {_why_position(slope, None, 1.0, own)}"
        )
    slope = _beyond(gaps, "gap")
    if slope is not None:
        return f"typically, {_why_gap(slope, units or {})}"
    return None


def _beyond(slopes: Sequence[float], quantity: str) -> float | None:
    """Returns the median of many slopes where it is out of its bounds."""
    if len(slopes) < _MANY:
        return None
    low, high = _TYPICAL[quantity]
    median = float(np.median(slopes))
    if low <= median <= high:
        return None
    return median


def _why_gap(gap: float, units: Units) -> str:
    """Returns why a gap does not change as the relative speed says."""
    own = _units_of("follower", units)
    reason = _named(gap, _factors(own, slower=("gap",), faster=("speed",)), 0.15)
    return (
        f"the gap changes {gap:.3g} times as the relative speed says:"
        f" {reason or 'gaps must be in m, speeds in m/s'}"
    )


def _units_of(who: str, units: Units) -> dict[str, str]:
    """Returns the unit of each quantity of the leader or the follower."""
    own = {}
    for quantity, si in _SI.items():
        name = quantity
        if who == "leader" and quantity not in {"gap", "time"}:
            name = f"leader_{quantity}"
        own[quantity] = units.get(name, si)
    return own


def _factors(
    own: Units, faster: Sequence[str] = (), slower: Sequence[str] = ()
) -> dict[float, str]:
    """Returns what slopes say of units: the slope, and the unit that a quantity seems to have.

    Args:
        own: the unit in which each quantity was read.
        faster: quantities whose integral grows too fast where they are in a smaller unit.
        slower: quantities that are integrals.
    """
    found: dict[float, str] = {}
    for quantity in (*faster, *slower):
        read = factor(own[quantity], _SI[quantity])
        for unit in _LIKELY[quantity]:
            scale = factor(unit, _SI[quantity]) / read
            if quantity in slower:
                scale = 1 / scale
            if unit == own[quantity]:
                continue
            words = f"the {quantity}s look like {unit}, not {own[quantity]}"
            same = [one for one in found if abs(one / scale - 1) < 1e-9]
            for one in same:
                words = f"{found.pop(one)}, or {words}"
            found[scale] = words
    return found


def _why_position(position: float, speed: float | None, dt: float, own: Units) -> str:
    """Returns why a distance is not speed times time, from that and the slope of the speed."""
    if position < 0:
        return "positions must grow along the lane"
    if speed is not None and abs(speed / position - 1) < _SAME:
        return (
            f"speeds change as much faster than the accelerations say, so the time step looks like"
            f" {position * dt:.3g} s, not {dt:.3g} s"
        )
    reason = _named(position, _factors(own, faster=("speed", "time"), slower=("position",)))
    return reason or "positions must be in m, speeds in m/s and times in s"


def _named(factor: float, known: dict[float, str], room: float = _SAME) -> str | None:
    """Returns what is known of the nearest factor, if it is near."""
    nearest = min(known, key=lambda one: abs(factor / one - 1))
    if abs(factor / nearest - 1) < room:
        return known[nearest]
    return None


def contradictions(pairs: PairSet, units: Units | None = None) -> Iterator[tuple[str, str]]:
    """Yields the id of each pair that contradicts itself, and how."""
    for pair in pairs:
        how = contradiction(pair, units)
        if how is not None:
            yield pair.pair_id, how


def in_words(pairs: PairSet, units: Units | None = None) -> str:
    """Returns which pairs contradict themselves, how and what to do; "" if none does."""
    found = list(contradictions(pairs, units))
    if not found:
        typical = typical_contradiction(pairs, units)
        if typical is None:
            return ""
        return f"{pairs.source}: the {len(pairs)} pairs together contradict themselves: {typical}"
    named = "; ".join(f"pair '{name}': {how}" for name, how in found[:_SHOWN])
    count = f"{len(found)} of {len(pairs)} pairs contradict themselves"
    if len(found) == 1:
        count = f"one of {len(pairs)} pairs contradicts itself"
    more = f" (and {len(found) - _SHOWN} more)" if len(found) > _SHOWN else ""
    return f"{pairs.source}: {count}: {named}{more}"


def check_kinematics(pairs: PairSet, check: Check, units: Units | None = None) -> None:
    """Refuses or reports pairs that contradict themselves, as `data.check` says.

    Args:
        units: those that the file is said to have; None: there is nothing to say.

    Raises:
        DataError: `check` is `refuse`, and some do.
    """
    if check == "off":
        return
    words = in_words(pairs, units)
    if words and check == "refuse":
        remedy = "correct the file"
        if units is not None:
            remedy += ", say which units it has (data.columns and data.units)"
        raise DataError(
            f"{words}; {remedy}, leave these pairs out, or say data.check=report to go on"
        )
    if words:
        log.warning("%s (data.check=report)", words)
