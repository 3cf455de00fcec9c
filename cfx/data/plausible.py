"""What a recording may hold but rarely does: asked about in `data describe`, warned of by jobs.

It is neither impossible nor a contradiction (`cfx.data.kinematics`), so nothing is refused.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from cfx.data.pairs import Pair, PairSet, of_each, twins
from cfx.data.style import STANDING_MPS
from cfx.data.tracks import beyond_rates, follows_from_gaps

Marks = NDArray[np.bool_]

_LONG_M = 11.0
_HARSH_MPS2 = 3.0
_STANDING_GAP_M = 6.0
_FAR_M = 200.0
"""Bounds of what is typical: a vehicle's length, accelerations, the gap to stand at, and a gap.

In the recordings of docs/readers.md the typical length is 4.5 m, nine accelerations in ten are
below 1.4 m/s2, and vehicles stand 3 to 4 m behind their leaders.
"""

_MANY = 4
"""Pairs that say what is typical."""

_FROZEN_S = 1.0
"""A signal that stays the same for this long while its rate says otherwise is frozen, s."""


def doubts(pairs: PairSet) -> Iterator[str]:
    """Yields a sentence for each sign that signals are not what they are said to be."""
    for remark in pairs.remarks:
        if not remark.is_contradiction:
            yield remark.text
    length = float(np.median(of_each(pairs, "leader_length")))
    if length > _LONG_M:
        yield f"leaders are typically {length:.1f} m long: feet, or lorries only?"
    if len(pairs) >= _MANY:
        nine_tenths = []
        for acceleration in of_each(pairs, "follower_acceleration"):
            nine_tenths.append(np.quantile(np.abs(acceleration), 0.9))
        harsh = float(np.median(nine_tenths))
        if harsh > _HARSH_MPS2:
            yield (
                f"accelerations are typically large (a tenth above {harsh:.1f} m/s2): are the"
                " file's lengths, speeds and accelerations in feet, or its times wrong?"
            )
    gaps = []
    for pair in pairs:
        stands = pair.follower_speed < STANDING_MPS
        if stands.any():
            gaps.append(np.min(pair.gap[stands]))
    if len(gaps) >= _MANY and np.median(gaps) > _STANDING_GAP_M:
        yield (
            f"vehicles that stand are typically {np.median(gaps):.1f} m behind their leaders: are"
            " gaps from bumper to bumper, not from front to front or centre to centre?"
        )
    typical_gaps = np.array(list(map(np.median, of_each(pairs, "gap"))))
    far_apart = np.count_nonzero(typical_gaps > _FAR_M)
    if far_apart:
        farthest = int(np.argmax(typical_gaps))
        yield (
            f"{far_apart} of {len(pairs)} pairs are typically more than {_FAR_M:g} m apart"
            f" ('{pairs[farthest].pair_id}': {typical_gaps[farthest]:,.0f} m): is the leader the"
            " vehicle ahead, are positions in one unit?"
        )
    originals_and_copies = twins(pairs)
    if originals_and_copies:
        original, copy = originals_and_copies[0]
        _, all_copies = zip(*originals_and_copies, strict=True)
        copies = set(all_copies)  # a copy of several pairs counts once
        yield (
            f"{len(copies)} of {len(pairs)} pairs drive as another one does, to 0.1 m and m/s"
            f" ('{copy}' as '{original}'): leave copies out, or who is learned from is tested too"
        )
    for what, wrong in _DOUBTFUL.items():
        yield from _counted(pairs, what, wrong)


def rare(pairs: PairSet) -> Iterator[str]:
    """Yields a sentence for each kind of frames that recordings have, but few."""
    for what, (wrong, advice) in _RARE.items():
        for counted in _counted(pairs, what, wrong):
            yield f"{counted}: {advice}"
    backwards = list(_counted(pairs, "steps in which a vehicle moves backwards", _goes_back))
    for counted in backwards:
        backing = [pair for pair in pairs if _goes_back(pair).any()]
        if all(map(follows_from_gaps, backing)):
            yield (
                f"{counted}: positions follow from the leader's speed and the gap here, so this is"
                " the noise of the gap while vehicles stand or creep, and no contradiction; use it"
                " as it is"
            )
        else:
            yield (
                f"{counted}: noise of the positions while vehicles stand or creep; if it is more"
                " than that, leave out these pairs"
            )


def _goes_back(pair: Pair) -> Marks:
    """Marks steps in which the follower moves backwards, `(T - 1,)`."""
    return np.diff(pair.follower_position) < 0


def _jumps(pair: Pair) -> Marks:
    """Marks steps in which a position moves otherwise than its speeds allow, `(T - 1,)`."""
    # A speed that rises at 4 m/s2 and falls again within the step moves a vehicle by
    # 4 (dt / 2)^2 = dt^2 m beyond what the speeds at both ends say; 1 m is left for noise.
    room = 1.0 + pair.dt**2
    jumps = np.zeros(len(pair) - 1, dtype=bool)
    for who in ("leader", "follower"):
        position, speed = getattr(pair, f"{who}_position"), getattr(pair, f"{who}_speed")
        jumps |= np.abs(beyond_rates(position, speed, pair.dt)) > room
    return jumps


def _speed_jumps(pair: Pair) -> Marks:
    """Marks steps in which a speed changes by more than full braking, `(T - 1,)`."""
    # Full braking is 8 m/s2 on a dry road; 2 m/s are left for noise.
    largest_change = 2.0 + 8.0 * pair.dt
    leader_jumps = np.abs(np.diff(pair.leader_speed)) > largest_change
    return leader_jumps | (np.abs(np.diff(pair.follower_speed)) > largest_change)


def _is_frozen(pair: Pair) -> Marks:
    """Marks steps in which a signal stays the same for long although its rate says otherwise."""
    frozen = np.zeros(len(pair) - 1, dtype=bool)
    run = max(2, round(_FROZEN_S / pair.dt))
    for who in ("leader", "follower"):
        for name, rate, least in (("position", "speed", 1.0), ("speed", "acceleration", 0.3)):
            is_frozen = np.diff(getattr(pair, f"{who}_{name}")) == 0
            is_frozen &= np.abs(getattr(pair, f"{who}_{rate}")[1:]) > least
            if len(is_frozen) >= run:
                # Where a run of that many frozen steps begins; then all of its steps.
                begins = np.convolve(is_frozen, np.ones(run), mode="valid") == run
                frozen |= np.convolve(begins, np.ones(run), mode="full") > 0
    return frozen


_DOUBTFUL: Mapping[str, Callable[[Pair], Marks]] = {
    "steps in which a position moves 1 m more or less than its speed says": _jumps,
    "steps in which a speed jumps as no vehicle's does": _speed_jumps,
    f"steps in which a signal stays the same for {_FROZEN_S:g} s although it should change": (
        _is_frozen
    ),
}
_RARE: Mapping[str, tuple[Callable[[Pair], Marks], str]] = {
    "frames with a gap below 0.5 m": (
        lambda pair: pair.gap < 0.5,
        "are lengths and positions right?",
    ),
    "frames with a speed above 50 m/s": (
        lambda pair: np.maximum(pair.leader_speed, pair.follower_speed) > 50,
        "are speeds in m/s?",
    ),
    "frames with an acceleration or braking above 8 m/s2": (
        lambda pair: np.abs(pair.follower_acceleration) > 8,
        "noise of differences of speeds, or a wrong unit",
    ),
}
"""What is counted, which frames of a pair count, and what to ask of them."""


def _counted(pairs: PairSet, what: str, wrong: Callable[[Pair], Marks]) -> Iterator[str]:
    """Yields how many frames are wrong and where most of them are; nothing if none is."""
    counts = [int(np.count_nonzero(wrong(pair))) for pair in pairs]
    if any(counts):
        worst = pairs[int(np.argmax(counts))].pair_id
        yield (
            f"{sum(counts):,} {what}, in {np.count_nonzero(counts)} of {len(pairs)} pairs,"
            f" most of them in '{worst}'"
        )
