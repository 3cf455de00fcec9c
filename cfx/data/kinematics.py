"""Position, speed, acceleration, gap and time of a pair must tell the same story.

A signal must change as the integral of its rate says: positions as speeds, speeds as accelerations,
the gap as the relative speed. Three things are measured for each pair:

- the slope of the signal on the integral, which is 1 where all are in the units that they should
  be in. Integrals are compared, not differences of neighbouring frames, in which noise drowns
  everything; over windows of `_WINDOW_S`, because a small bias of a speed adds up over minutes. The
  less of the signal the integral explains, the more room the slope has (`_Rule`);
- what the integral leaves over in most windows: another vehicle's signal, or one that comes late,
  has the right slope;
- jumps from one frame to the next that no vehicle makes.

A source integrates by a rule of its own: simulators move a vehicle by its new speed (SUMO's Euler
steps, cfx) or its old one, recordings by the mean of both. At a step of 1 s the rules differ by
half a second's change of speed, so each signal is compared with the rule that it follows best.
Between two frames a rate is not known: the coarser the step and the noisier the rate, the less its
integral says. How much less is measured on the rate itself, by what its integral changes if every
second frame is left out (`_step_errors`), and not held against the signal.

The medians over many pairs have little room (`_TYPICAL`). What agrees with itself cannot be seen: a
pair all of whose signals are in feet is a pair of fast vehicles far apart
(`cfx.data.plausible` asks about such).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from cfx.data.files import Floats
from cfx.data.pairs import Pair, PairSet
from cfx.data.tracks import beyond_rates, follows_from_gaps
from cfx.data.units import factor

_WINDOW_S = 5.0
"""Length of the windows over which changes are compared, s: longer than noise, and so short that
a small bias of a speed does not add up."""

_WINDOWS = 200
"""Windows of a pair that are looked at, at least, where it has as many; they overlap."""

_MIN_FRAMES = 12
"""Shorter signals are not compared: in them it matters whether a rate is that of the step before a
frame, of the step after it, or the mean of both."""

_FACTOR_ROOM = 0.08
"""How far, as a share, a slope may be from the factor between two units that explains it."""

_GAP_FACTOR_ROOM = 0.12
"""The same of a gap's change on the relative speed, which is noisier."""

_MOST_WINDOWS = 0.75
"""Of changes over windows this quantile counts: it holds for most windows, and a few bad ones do
not matter."""

_MAX_MISSED = 0.25
"""Where an integral may miss a larger share of a change, what it leaves over says nothing. So it is
at 1 s with the accelerations of OpenACC's Ispra, which are noisy and whose speeds hardly change."""


@dataclass(frozen=True)
class _Rule:
    """When a signal is compared with the integral of its rate, and how far they may differ.

    The bounds leave room for all pairs of the recordings that cfx was tried on; docs/readers.md
    has their slopes.

    Attributes:
        spread: a signal that varies less, in its unit, is not checked (`Agreement.spread`).
        floor: how far the logarithm of the slope may always be from 0.
        room: how much farther where the integral explains nothing of the signal.
        max_left_over: bound of `Agreement.left_over`; half of it where another vehicle's signal, or
            another time, leaves much less over.
        max_typical_left_over: bound of its median over many pairs.
    """

    spread: float
    floor: float
    room: float
    max_left_over: float = math.inf
    max_typical_left_over: float = math.inf

    def breaks_slope(self, agreement: Agreement) -> bool:
        """Says whether a slope is out of its bounds; False where the signals vary too little."""
        if agreement.spread < self.spread or agreement.unexplained > 0.95:
            return False
        if agreement.slope <= 0:
            return True
        return abs(math.log(agreement.slope)) > self.floor + self.room * agreement.unexplained

    def may_leave_too_much(self, agreement: Agreement) -> bool:
        """Says whether what the integral leaves over of the signal needs a closer look."""
        return self.can_judge(agreement) and agreement.left_over > self.max_left_over / 2

    def can_judge(self, agreement: Agreement) -> bool:
        """Says whether the signal varies, and its integral is known, enough to be compared."""
        return agreement.change >= 2 * self.spread and agreement.missed < _MAX_MISSED


_WHOLE = _Rule(spread=10.0, floor=0.17, room=0.0)
"""Rule of the distance driven over the whole pair."""

_RULES = {
    "position": _Rule(2.0, 0.08, 1.2, 0.6, 0.15),
    "speed": _Rule(0.5, 0.08, 1.2, 0.45),
    "gap": _Rule(1.0, 0.08, 1.2, 0.9, 0.4),
}
"""Rules of changes over windows."""

_TYPICAL = 0.04
"""How far the median slope of `_FEW_PAIRS` or more may be from 1, beside its uncertainty."""

_FEW_PAIRS, _MANY_PAIRS = 4, 8
"""From how many pairs on their median says something, and from how many it is sure."""

_LATEST_S = 3.0
"""Delays of one signal behind another that are looked for."""

_LEAP_M, _LEAP_M_PER_S = 40.0, 100.0
_LEAP_MPS, _LEAP_MPS2 = 5.0, 15.0
"""Steps from frame to frame that no vehicle makes: of a position beside what its speed says, and of
a speed, so much and so much more for each second of the step. A sensor that has lost its target
moves to the next one within half a second: by 73 m in OpenACC's Vicolungo."""

_MOST_MPS2 = 30.0
"""An acceleration that no vehicle has."""

_FEW = 0.05
"""Share of the steps that are few: single frames are wrong, not a unit."""

_SI = {"position": "m", "speed": "m/s", "acceleration": "m/s2", "gap": "m", "time": "s"}

_LIKELY = {
    "position": ("m", "ft", "cm", "mm", "km"),
    "gap": ("m", "ft", "cm"),
    "speed": ("m/s", "km/h", "ft/s", "mph", "kn", "cm/s"),
    "time": ("s", "ms", "us", "ns"),
    "acceleration": ("m/s2", "g_0", "ft/s2", "km/h/s"),
}
"""Units in which recordings have a quantity; more would be taken for one another."""

_LIKELY_BY_GAP = ("m/s", "km/h", "ft/s", "mph")
"""Units of speeds beside gaps alone, where knots cannot be told from a time step twice as long."""

_ACCELERATION_FACTORS = {
    10.0: "they are 0.1 times what the speeds say; write m/s2",
    -1.0: "their sign is turned; braking is negative",
}


@dataclass(frozen=True)
class Agreement:
    """How a signal changes beside the integral of its rate.

    Attributes:
        slope: change of the signal over that of the integral, with the sign of their correlation.
        correlation: -1 to 1.
        spread: standard deviation of the signal or of the integral, whichever is larger, in the
            signal's unit.
        change: of the signal or of the integral in most windows.
        left_over: what the integral leaves over of that change, as a share, beside `missed`.
        missed: what the integral may miss between frames of that change, as a share.
    """

    slope: float
    correlation: float
    spread: float
    change: float
    left_over: float
    missed: float = 0.0

    @property
    def unexplained(self) -> float:
        """Share of the signal's standard deviation that the integral does not explain, 0 to 1."""
        return math.sqrt(max(0.0, 1.0 - self.correlation**2))


def measured_agreement(
    values: Floats, rates: Floats, dt: float, *, whole: bool = False
) -> Agreement:
    """Measures how a signal changes beside the integral of its rate.

    The rate's integral is that of the rule that the signal follows best. What is not known of the
    rate between frames counts neither as left over nor as part of the integral's spread.

    Args:
        values: the signal, `(T,)`.
        rates: its rate, `(T,)`, per second.
        dt: time step, s.
        whole: the course since the first frame is compared, not changes over windows.
    """
    if len(values) < _MIN_FRAMES:
        return Agreement(math.nan, 0.0, 0.0, 0.0, 0.0)
    mean = np.zeros(len(rates))
    np.cumsum(rates[1:] + rates[:-1], out=mean[1:])
    # The signal, its rate's integral by the mean rule, and what the new rate's rule adds to it.
    y, mean, turn = values, mean * (0.5 * dt), rates * (0.5 * dt)
    unknown = _step_errors(rates, dt)
    window = max(1, round(_WINDOW_S / dt))
    if not whole and len(values) > 2 * window:
        stride = max(1, (len(values) - window) // _WINDOWS)

        def over_windows(course: Floats) -> Floats:
            return (course[window:] - course[:-window])[::stride]

        y, mean = over_windows(y), over_windows(mean)
        turn, unknown = over_windows(turn), over_windows(unknown)
    y = y - _quantile(y, 0.5)
    of_y = math.sqrt(float(y @ y))
    x, of_x, correlation = _best_integral(y, of_y, mean, turn)
    spread = max(of_x, of_y) / math.sqrt(len(x))
    change = max(_quantile(np.abs(x), _MOST_WINDOWS), _quantile(np.abs(y), _MOST_WINDOWS))
    left_over = missed = 0.0
    if change > 0:
        missed = _quantile(np.abs(unknown), _MOST_WINDOWS) / change
        left_over = max(0.0, _quantile(np.abs(y - x), _MOST_WINDOWS) / change - missed)
    if min(of_x, of_y) <= 1e-6 * max(of_x, of_y):
        return Agreement(math.nan, 0.0, spread, change, left_over, missed)
    # Errors that do not go with the signal widen the integral as they lower the correlation.
    certain = math.sqrt(max(of_x**2 - float(unknown @ unknown), (correlation * of_x) ** 2))
    slope = math.copysign(of_y / max(certain, 1e-6 * of_x), correlation)
    return Agreement(slope, correlation, spread, change, left_over, missed)


def _best_integral(
    y: Floats, of_y: float, mean: Floats, turn: Floats
) -> tuple[Floats, float, float]:
    """Returns the integral that a signal follows best, its norm, and the correlation of both.

    Args:
        y: changes of the signal, `(W,)`.
        of_y: norm of `y`.
        mean: integral of the rate if each step is driven at the mean of the rates at its ends.
        turn: what is added to that if each step is driven at its new rate; at its old one, the same
            is taken away.
    """
    best = None
    for share in (1.0, 0.0, -1.0):
        x = mean + share * turn
        x = x - _quantile(x, 0.5)
        of_x = math.sqrt(float(x @ x))
        correlation = 0.0
        if of_x * of_y > 0:
            correlation = min(1.0, max(-1.0, float(x @ y) / (of_x * of_y)))
        if best is None or abs(correlation) > abs(best[2]):
            best = x, of_x, correlation
    assert best is not None
    return best


def _step_errors(rates: Floats, dt: float) -> Floats:
    """Returns what an integral up to each frame changes if every second frame is left out, `(T,)`.

    This is as large as the error of the integral itself where the rate is noisy from frame to
    frame, and three times as large where it is smooth (L. F. Richardson 1911).
    """
    errors = np.zeros(len(rates))
    errors[2::2] = 0.5 * dt * (rates[:-2] - 2 * rates[1:-1] + rates[2:])[::2]
    return np.cumsum(errors)


def _quantile(values: Floats, share: float) -> float:
    """Returns a quantile, without interpolation, which is much faster than NumPy's own."""
    at = int(share * (len(values) - 1))
    return float(np.partition(values, at)[at])


Units = Mapping[str, str]
"""Units that a file is said to have in place of SI units, by `Dataset.units`'s names."""


@dataclass(frozen=True)
class Contradiction:
    """How two signals of a pair contradict each other.

    Attributes:
        signals: their names.
        quantity: the one that is an integral: position, speed or gap.
        slope: of it on the integral of the other; None where another thing is wrong.
        words: what is wrong, where that does not follow from the slope and the file's units.
        dt: time step, s.
        other_slope: of the vehicle's other signal, where it is exact: with a position that of the
            speed, with a speed that of the position.
    """

    signals: str
    quantity: str
    slope: float | None
    words: str
    dt: float
    other_slope: float | None = None

    def text(self, units: Units | None = None) -> str:
        """Returns which signals contradict each other, and the probable reason.

        Args:
            units: those that the file is said to have in place of SI units.
        """
        if self.slope is None or self.words:
            return f"{self.signals}: {self.words}"
        return f"{self.signals}: {self._reason(self.slope, units or {})}"

    def _reason(self, slope: float, units: Units) -> str:
        """Returns what a slope says, and which unit, sign or time step would explain it."""
        step = f"the time step looks like {slope * self.dt:.3g} s, not {self.dt:.3g} s"
        other = self.other_slope
        read_in = _units_of(self.signals.partition("_")[0], units)
        room = _FACTOR_ROOM
        if self.quantity == "gap":
            finding = f"the gap changes {slope:.3g} times as the relative speed says"
            explanations = {-1.0: "the leader's and the follower's columns look swapped"}
            explanations |= _factors(read_in, slower=("gap",), faster=("speed",))
            otherwise = (
                f"gaps must be in {read_in['gap']}, speeds in {read_in['speed']}, times in"
                f" {read_in['time']}"
            )
            room = _GAP_FACTOR_ROOM
        elif self.quantity == "speed":
            finding = f"speeds change {slope:.3g} times as much as the accelerations say"
            if (
                other is not None
                and abs(other - 1) > _TYPICAL
                and abs(slope / other - 1) < _FACTOR_ROOM
            ):
                return f"{finding}, and positions as much more than the speeds say, so {step}"
            explanations = _ACCELERATION_FACTORS | _factors(
                read_in, faster=("acceleration",), slower=("speed",)
            )
            otherwise = f"they are {1 / slope:.2g} times what the speeds say; write m/s2"
        else:
            finding = f"the distance driven is {slope:.3g} times speed times time"
            if slope < 0:
                return f"{finding}: positions must grow along the lane"
            if other is not None and abs(other / slope - 1) < _FACTOR_ROOM:
                finding += ": speeds change as much faster than the accelerations say"
                return f"{finding}, so {step}"
            explanations = _factors(read_in, faster=("speed", "time"), slower=("position",))
            otherwise = (
                f"positions must be in {read_in['position']}, speeds in {read_in['speed']}, times"
                f" in {read_in['time']}, and all of this vehicle"
            )
        nearest = min(explanations, key=lambda expected: abs(slope / expected - 1))
        if abs(slope / nearest - 1) < room:
            return f"{finding}: {explanations[nearest]}"
        return f"{finding}: {otherwise}"


class _Relation(NamedTuple):
    """A signal of a pair and its rate, `(T,)` each."""

    pair: Pair
    signals: str
    quantity: str
    values: Floats
    rates: Floats

    def measured(self, *, whole: bool = False) -> Agreement:
        """Returns how changes over windows agree, or over the whole pair."""
        return measured_agreement(self.values, self.rates, self.pair.dt, whole=whole)

    def contradiction(
        self, slope: float | None, words: str = "", of_other_signal: Agreement | None = None
    ) -> Contradiction:
        """Returns that signal and rate contradict each other.

        Args:
            slope: of the signal on the integral; None where another thing is wrong.
            words: what is wrong, where the slope does not say it.
            of_other_signal: how the vehicle's other signal agrees with its rate; one that the
                integral hardly explains says nothing.
        """
        other_slope = None
        if of_other_signal is not None and of_other_signal.unexplained < 0.2:
            other_slope = of_other_signal.slope
        return Contradiction(self.signals, self.quantity, slope, words, self.pair.dt, other_slope)


def _relations(pair: Pair, who: str) -> tuple[_Relation, _Relation]:
    """Returns position and speed, and speed and acceleration, of leader or follower."""
    speed = f"{who}_speed"
    return _relation(pair, f"{who}_position", speed), _relation(pair, speed, f"{who}_acceleration")


def _relation(pair: Pair, signal: str, rate: str) -> _Relation:
    """Returns a signal of leader or follower and its rate, both by name."""
    _, _, quantity = signal.partition("_")
    values, rates = getattr(pair, signal), getattr(pair, rate)
    return _Relation(pair, f"{signal} and {rate}", quantity, values, rates)


def _gap_relation(pair: Pair) -> _Relation:
    closing = pair.leader_speed - pair.follower_speed
    return _Relation(pair, "gap and speeds", "gap", pair.gap, closing)


def contradiction(pair: Pair, units: Units | None = None) -> Contradiction | None:
    """Returns the first contradiction between signals of a pair; None if there is none.

    Args:
        units: those that its file is said to have; its signals are in SI units.
    """
    for who, other in (("leader", "follower"), ("follower", "leader")):
        position, speed = _relations(pair, who)
        of_position, of_speed = _relations(pair, other)
        problem = _contradiction_in(position, of_position, speed.measured())
        if problem is not None:
            return _by_gap(problem, pair, units or {})
        problem = _contradiction_in(speed, of_speed, position.measured(whole=True))
        if problem is not None:
            return problem
    problem = _over_windows(_gap_relation(pair), None, None)
    if problem is None:
        return None
    return _by_gap(problem, pair, units or {})


def _contradiction_in(
    relation: _Relation, of_neighbour: _Relation, of_other_signal: Agreement
) -> Contradiction | None:
    """Compares a signal with its rate; None if it changes as the rate says.

    Args:
        relation: the signal and its rate.
        of_neighbour: the same signal of the other vehicle: columns may be swapped.
        of_other_signal: how this vehicle's other signal agrees with its rate.
    """
    problem = _leap(relation) or _constant(relation)
    if problem is not None:
        return problem
    if relation.quantity == "position":
        whole = relation.measured(whole=True)
        if _WHOLE.breaks_slope(whole):
            return relation.contradiction(whole.slope, of_other_signal=of_other_signal)
    return _over_windows(relation, of_neighbour, of_other_signal)


def _over_windows(
    relation: _Relation, of_neighbour: _Relation | None, of_other_signal: Agreement | None
) -> Contradiction | None:
    """Compares a signal's changes over windows with its rate; as `_contradiction_in`."""
    rule, agreement = _RULES[relation.quantity], relation.measured()
    if rule.breaks_slope(agreement):
        return relation.contradiction(agreement.slope, of_other_signal=of_other_signal)
    if not rule.may_leave_too_much(agreement):
        return None
    reason = _reason_left_over(relation, of_neighbour, agreement.left_over)
    if not reason and agreement.left_over < rule.max_left_over:
        return None
    words = (
        f"over {_WINDOW_S:g} s the one changes otherwise than the other says, by"
        f" {agreement.left_over:.0%} of the change:"
        f" {reason or 'are they of this vehicle, at this time?'}"
    )
    return relation.contradiction(None, words)


def _reason_left_over(relation: _Relation, of_neighbour: _Relation | None, left_over: float) -> str:
    """Returns why a signal does not go with its rate: another vehicle's, or late; "" if unknown.

    Args:
        relation: the signal and its rate.
        of_neighbour: the same of the other vehicle.
        left_over: what the rate's integral leaves over of the signal, as a share. Another
            vehicle's rate must leave much less, one at another time less than 0.4 times as much.
    """
    dt = relation.pair.dt
    if of_neighbour is not None:
        of_swapped = measured_agreement(relation.values, of_neighbour.rates, dt)
        if of_swapped.left_over < left_over / 3:
            rate = of_neighbour.signals.partition(" and ")[2]
            return f"they go with {rate}: are the columns swapped?"
    delay, least_left_over = 0, left_over  # frames by which the rate is later
    for k in range(1, min(round(_LATEST_S / dt), len(relation.values) // 4) + 1):
        for frames in (k, -k):
            values, rates = relation.values, relation.rates
            if frames > 0:
                values, rates = values[:-k], rates[k:]
            else:
                values, rates = values[k:], rates[:-k]
            left_over_then = measured_agreement(values, rates, dt).left_over
            if left_over_then < least_left_over:
                delay, least_left_over = frames, left_over_then
    if least_left_over < left_over / 2.5:
        words = "earlier"
        if delay > 0:
            words = "later"
        return f"they go together if the second is taken {abs(delay) * dt:.3g} s {words}"
    return ""


def _leap(relation: _Relation) -> Contradiction | None:
    """Finds the first of a few steps that no vehicle makes; many mean a wrong unit."""
    pair, moved = relation.pair, np.diff(relation.values)
    most, rate = _LEAP_MPS + _LEAP_MPS2 * pair.dt, _MOST_MPS2
    if relation.quantity == "position":
        moved = beyond_rates(relation.values, relation.rates, pair.dt)
        most, rate = _LEAP_M + _LEAP_M_PER_S * pair.dt, math.inf
    leaps = (np.abs(moved) > most) | (np.abs(relation.rates[1:]) > rate)
    at = np.flatnonzero(leaps)
    if not len(at) or len(at) > max(2.0, _FEW * len(moved)):
        return None
    frame = pair.first_frame + int(at[0]) + 1
    what = f"the {relation.quantity} leaps by {moved[at[0]]:.3g} {_SI[relation.quantity]}"
    if abs(moved[at[0]]) <= most:
        what = f"the acceleration is {relation.rates[at[0] + 1]:.3g} m/s2"
    words = (
        f"at frame {frame} {what} within a step of {pair.dt:.3g} s ({len(at)} such steps): cut the"
        " pair there, or correct it"
    )
    return relation.contradiction(None, words)


def _constant(relation: _Relation) -> Contradiction | None:
    """Finds a signal that is the same in all frames although the other one says otherwise."""
    signal, rate = relation.signals.split(" and ")
    has_constant_values = bool((relation.values == relation.values[0]).all())
    has_constant_rates = bool((relation.rates == relation.rates[0]).all())
    if has_constant_values == has_constant_rates:
        return None
    # Positions grow at a constant speed, too.
    whole = relation.measured(whole=not (has_constant_rates and relation.quantity == "position"))
    if whole.spread < 2 * _RULES[relation.quantity].spread or whole.left_over < 0.5:
        return None
    name, value = signal, relation.values[0]
    if has_constant_rates:
        name, value = rate, relation.rates[0]
    words = f"{name} is {value:.3g} in every frame, and the other changes"
    return relation.contradiction(None, words)


def _by_gap(problem: Contradiction, pair: Pair, units: Units) -> Contradiction:
    """Explains a contradiction where a file has gaps: its positions were made from them."""
    read_in = _units_of("follower", units)
    if problem.quantity == "speed" or not follows_from_gaps(pair):
        return problem
    gap, leader, follower = pair.gap, pair.leader_speed, pair.follower_speed
    swapped = "the leader's and the follower's speeds look swapped, or the gap's sign turned"
    corrected = {swapped: (gap, follower, leader)}
    corrected["the leader's speeds look relative to the follower's"] = (
        gap,
        leader + follower,
        follower,
    )
    slope = _gap_relation(pair).measured().slope
    slopes_of: dict[str, float] = {}
    for unit in _LIKELY["gap"]:
        if unit == read_in["gap"]:
            continue
        scale = factor(unit, "m") / factor(read_in["gap"], "m")
        slopes_of[f"the gaps look like {unit}, not {read_in['gap']}"] = 1 / scale
    for unit in _LIKELY_BY_GAP:
        if unit == read_in["speed"]:
            continue
        scale = factor(unit, "m/s") / factor(read_in["speed"], "m/s")
        look = f"look like {unit}, not {read_in['speed']}"
        slopes_of[f"the speeds {look}"] = scale
        corrected[f"the leader's speeds {look}"] = (gap, leader * scale, follower)
        corrected[f"the follower's speeds {look}"] = (gap, leader, follower * scale)
    likely = dict(slopes_of)
    for words, expected in slopes_of.items():
        if abs(slope / expected - 1) >= _GAP_FACTOR_ROOM:
            del likely[words]
    if not likely and slope > 0:
        likely[f"the time step looks like {slope * pair.dt:.3g} s, not {pair.dt:.3g} s"] = slope
    for words, scale in likely.items():
        corrected[words] = (gap, leader * scale, follower * scale)
    # The correction after which gap and speeds agree best; one that leaves half of the change over
    # explains nothing.
    explanation, least_left_over = problem.words, 0.5
    for words, (gaps, ahead, behind) in corrected.items():
        agreement = measured_agreement(gaps, ahead - behind, pair.dt)
        if agreement.left_over < least_left_over and not _RULES["gap"].breaks_slope(agreement):
            explanation, least_left_over = words, agreement.left_over
    return replace(
        problem, signals="gap and speeds", quantity="gap", slope=slope, words=explanation
    )


def _units_of(who: str, units: Units) -> dict[str, str]:
    """Returns the unit of each quantity of the leader or the follower."""
    units_read = {}
    for quantity, si in _SI.items():
        name = quantity
        if who == "leader" and quantity not in {"gap", "time"}:
            name = f"leader_{quantity}"
        units_read[quantity] = units.get(name, si)
    return units_read


def _factors(
    read_in: Units, faster: Sequence[str] = (), slower: Sequence[str] = ()
) -> dict[float, str]:
    """Returns what each slope would mean: a quantity that is in another unit than it is read in.

    Args:
        read_in: the unit in which each quantity was read.
        faster: quantities whose integral grows too fast where they are in a smaller unit.
        slower: quantities that are integrals.
    """
    explanations: dict[float, str] = {}
    for quantity in (*faster, *slower):
        read = factor(read_in[quantity], _SI[quantity])
        for unit in _LIKELY[quantity]:
            scale = factor(unit, _SI[quantity]) / read
            if quantity in slower:
                scale = 1 / scale
            if unit == read_in[quantity]:
                continue
            words = f"the {quantity}s look like {unit}, not {read_in[quantity]}"
            for expected in list(explanations):
                if abs(expected / scale - 1) < 1e-9:
                    words = f"{explanations.pop(expected)}, or {words}"
            explanations[scale] = words
    return explanations


def contradictions(
    pairs: PairSet, units: Units | None = None
) -> Iterator[tuple[str, Contradiction]]:
    """Yields the id of each pair that contradicts itself, and how."""
    for pair in pairs:
        problem = contradiction(pair, units)
        if problem is not None:
            yield pair.pair_id, problem


def typical_contradiction(pairs: PairSet) -> Contradiction | None:
    """Returns a contradiction that only all pairs together show; None if there is none.

    Pairs in time steps of their own are compared too: a slope has no unit.
    """
    slopes: dict[tuple[str, str], list[float]] = {}
    left_over: dict[tuple[str, str], list[float]] = {}
    missed: dict[tuple[str, str], list[float]] = {}
    for pair in pairs:
        relations = (*_relations(pair, "leader"), *_relations(pair, "follower"))
        for relation in (*relations, _gap_relation(pair)):
            key = relation.signals, relation.quantity
            agreement, rule = relation.measured(), _RULES[relation.quantity]
            if rule.can_judge(agreement):
                left_over.setdefault(key, []).append(agreement.left_over)
            if relation.quantity == "position":
                agreement, rule = relation.measured(whole=True), _WHOLE
            if agreement.spread >= rule.spread and agreement.slope > 0:
                slopes.setdefault(key, []).append(math.log(agreement.slope))
                missed.setdefault(key, []).append(agreement.missed)
    for key, logs in slopes.items():
        median, room = _median(logs)
        # Where a rate is smooth, what its integral misses goes with the signal and changes the
        # slope: accelerations that are differences of speeds over two steps of 1 s make it 1.06.
        room += float(np.median(missed[key]))
        if len(logs) >= _FEW_PAIRS and abs(median) > _TYPICAL + room:
            return Contradiction(*key, math.exp(median), "", 1.0)
    for key, shares in left_over.items():
        share, room = _median(shares)
        if len(shares) >= _FEW_PAIRS and share > _RULES[key[1]].max_typical_left_over + room:
            words = (
                f"over {_WINDOW_S:g} s the one changes otherwise than the other says, typically by"
                f" {share:.0%} of the change: are they of the same time?"
            )
            return Contradiction(*key, None, words, 1.0)
    return None


def _median(values: Sequence[float]) -> tuple[float, float]:
    """Returns the median, and how uncertain it is.

    Six median deviations over the root of the number of pairs; of few pairs, whose deviations say
    little, two of the largest. Of draws of 4 to 20 of ZalaZone's pairs, which agree worst, fewer
    than one in a thousand is refused.
    """
    median = float(np.median(values))
    deviations = np.abs(np.array(values) - median)
    if len(values) < _MANY_PAIRS:
        return median, 2.0 * float(deviations.max())
    return median, 6.0 * float(np.median(deviations)) / math.sqrt(len(values))
