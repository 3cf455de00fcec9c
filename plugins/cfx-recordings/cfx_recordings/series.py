"""Pairs that a source gives as series over time: what follows from speeds and gaps, the cuts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cfx.errors import DataError
from cfx.plugin import Dropped, Floats, Ints, Pair, PairSet, Remark, tracks

_STEP_ROOM = 0.05
"""How far the typical step between times may be from the layout's, as a share of it."""


@dataclass(frozen=True)
class Series:
    """One follower behind one leader, as a source gives them; missing values are NaN.

    Shapes: T frames; every array is `(T,)`, in SI units.

    Attributes:
        name: of the pair; each stretch that is cut out of it ends with -run2 and so on.
        dt: time step, s.
        frame: numbers of the frames, ascending; where one is missing, the pair is cut.
        signals: any of a pair's signals; both speeds at least.
        gap: bumper to bumper, m; None: both positions are given.
        leader_length: m; 0 where positions are rear bumpers' or unknown.
        labels: where any of these changes, the pair is cut; for instance who drives.
        site, vehicle: as of pairs.
        driver_types: what the values of `labels["driver_type"]` stand for; a single one without it.
    """

    name: str
    recording: str
    leader_id: str
    follower_id: str
    dt: float
    frame: Ints
    signals: Mapping[str, Floats]
    gap: Floats | None = None
    leader_length: float = 0.0
    labels: Mapping[str, Ints] = field(default_factory=dict)
    driver_types: Sequence[str] = ("",)
    leader_driver_type: str = ""
    site: str = ""
    vehicle: str = ""


def pairs_of(
    series: Sequence[Series],
    source: str,
    *,
    dropped: Sequence[Dropped] = (),
    remarks: Sequence[Remark] = (),
    max_gap: float | None = None,
) -> PairSet:
    """Cuts series into pairs of consecutive frames without missing or impossible values.

    A frame is left out, counted and ends the pair where a value is missing, a speed is negative,
    or the gap is 0 or less, or more than `max_gap`.

    Args:
        remarks: what was noticed about the source as a whole.
        max_gap: m; None: leaders may be anywhere ahead.
    """
    pairs: list[Pair] = []
    lost = list(dropped)
    ends: list[Dropped] = []
    seen: dict[str, int] = {}
    for source_pair in series:
        reasons = _left_out(source_pair, max_gap)
        is_good = ~np.any(list(reasons.values()), axis=0)
        good = np.flatnonzero(is_good)
        labels = [values[good] for values in source_pair.labels.values()]
        starts, sizes = tracks.runs(source_pair.frame[good] - np.arange(len(good)), *labels)
        is_pair = sizes > 1
        lost += tracks.count_reasons({**reasons, tracks.SINGLE_FRAME: sizes < 2}, "rows")
        stops = starts + sizes
        ends += tracks.count_reasons(_ends(source_pair, reasons, good[stops[is_pair] - 1]), "pairs")
        for start, stop in zip(starts[is_pair].tolist(), stops[is_pair].tolist(), strict=True):
            pairs.append(_pair(source_pair, slice(good[start], good[stop - 1] + 1), seen))
    return PairSet(
        tuple(pairs),
        source,
        tracks.totals_by_reason(lost),
        tracks.totals_by_reason(ends),
        tuple(remarks),
    )


def _left_out(source_pair: Series, max_gap: float | None) -> dict[str, tracks.Marks]:
    """Returns the frames that belong to no pair, by the first reason that holds."""
    values = list(source_pair.signals.values())
    if source_pair.gap is None:
        signals = source_pair.signals
        gap = signals["leader_position"] - source_pair.leader_length - signals["follower_position"]
    else:
        gap = source_pair.gap
        values.append(gap)
    slowest = np.minimum(source_pair.signals["leader_speed"], source_pair.signals["follower_speed"])
    furthest = np.inf
    if max_gap is not None:
        furthest = max_gap
    reasons: dict[str, tracks.Marks] = {
        "a value is missing": np.isnan(np.sum(values, axis=0)),
        "a speed is negative": slowest < 0,
        "the leader is behind its follower (gap of 0 or less)": gap <= 0,
        f"the leader is farther than {furthest:g} m": gap > furthest,
    }
    return tracks.first_that_holds(reasons)


def _ends(
    source_pair: Series, reasons: Mapping[str, tracks.Marks], last: Ints
) -> dict[str, tracks.Marks]:
    """Returns why each pair ends, by reason.

    Args:
        last: index of each pair's last frame.
    """
    after = np.minimum(last + 1, len(source_pair.frame) - 1)
    reasons_of_end: dict[str, tracks.Marks] = {
        "the source's pair ends": last + 1 == len(source_pair.frame)
    }
    reasons_of_end["frames are missing"] = source_pair.frame[after] != source_pair.frame[last] + 1
    for reason, holds in reasons.items():
        reasons_of_end[reason] = holds[after]
    for label, values in source_pair.labels.items():
        reasons_of_end[f"the {label.replace('_', ' ')} changes"] = values[after] != values[last]
    return tracks.first_that_holds(reasons_of_end)


def _pair(source_pair: Series, run: slice, runs: dict[str, int]) -> Pair:
    """Returns the pair of a stretch of good frames."""
    signals: dict[str, Any] = {}
    for name, values in source_pair.signals.items():
        signals[name] = values[run]
    if source_pair.gap is not None:
        leader = signals.get("leader_position")
        if leader is None:
            leader = (
                tracks.distance_driven(signals["leader_speed"], source_pair.dt)
                + source_pair.leader_length
            )
        signals["leader_position"] = leader
        signals["follower_position"] = leader - source_pair.leader_length - source_pair.gap[run]
    for who in ("leader", "follower"):
        if f"{who}_acceleration" not in signals:
            signals[f"{who}_acceleration"] = tracks.accelerations(
                signals[f"{who}_speed"], source_pair.dt
            )
    kind = 0
    if "driver_type" in source_pair.labels:
        kind = int(source_pair.labels["driver_type"][run.start])
    lane = None
    if "lane" in source_pair.labels:
        lane = int(source_pair.labels["lane"][run.start])
    return Pair(
        pair_id=tracks.unique_name(source_pair.name, runs),
        recording=source_pair.recording,
        leader_id=source_pair.leader_id,
        follower_id=source_pair.follower_id,
        first_frame=int(source_pair.frame[run.start]),
        dt=source_pair.dt,
        leader_length=source_pair.leader_length,
        lane=lane,
        driver_type=source_pair.driver_types[kind],
        leader_driver_type=source_pair.leader_driver_type,
        site=source_pair.site,
        vehicle=source_pair.vehicle,
        **signals,
    )


def frames_at(time: Floats, dt: float, source: str) -> Ints:
    """Returns the frame number of each time, 0 at the first, `(T,)`.

    Args:
        time: s.
        dt: step of the layout, s.
        source: file, and what of it.

    Raises:
        DataError: the times are mostly in other steps.
    """
    times = np.unique(time)
    # The times of two vehicles may differ by rounding.
    apart = times[np.append(True, np.diff(times) > _STEP_ROOM * dt)]
    if len(apart) > 0.4 * len(times):
        times = apart
    steps = np.diff(times)
    step = float(np.median(steps)) if len(steps) else dt
    if abs(step / dt - 1) > _STEP_ROOM:
        raise DataError(
            f"{source}: the time step is {step:.3g} s, not the {dt:g} s of this layout; correct the"
            " times, or write the tidy layout"
        )
    frames: Ints = np.rint((time - time[0]) / dt).astype(np.int64)
    return frames
