"""Looks for signs that a recording lacks vehicles.

Where a file names no leaders, the next vehicle in the lane counts as the leader. If a vehicle in
between was not recorded, the gap is too long, and the follower reacts to a vehicle that is not in
the data. The data do not contradict this, so what is found here is a warning, not an error.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from cfx.data.files import Floats, Ints
from cfx.data.pairs import Remark
from cfx.data.tracks import Marks, Tracks, changes, rows_ahead, runs

_SHARE = 0.1
"""Share of the vehicles that appear or vanish in mid-road; where all are recorded it is 0."""

_FAR_S, _FAR_M = 3.0, 10.0
"""A leader who is farther ahead than this time gap and distance, and not slower, does not hold up a
follower."""

_SLOW = 0.8
"""A driver below this share of their desired speed would go faster if they could."""

_DESIRED = 0.9
"""Quantile of a vehicle's speeds in a lane that counts as its desired speed there."""

_ACCELERATES_MPS2 = 0.1
"""A driver whose mean acceleration over a second is smaller does not accelerate."""

_HELD_UP = 0.25
"""Share of the moments at which slow drivers far behind a leader do not accelerate. It is 0 to 0.13
in simulations of two lanes with lorries, of a town with lights, and of stops in mid-road, and 0.3
to 0.9 where only 40 % of their vehicles are recorded."""

_LEAST_S, _LEAST_VEHICLES = 5.0, 3
"""With less time or fewer vehicles nothing is said."""

_QUESTION = (
    "are all vehicles recorded? Where the file names no leaders, the next recorded vehicle in the"
    " lane counts as one"
)


def remarks_on_leaders(tracks: Tracks) -> tuple[Remark, ...]:
    """Returns signs that leaders, found as the next vehicle in the lane, are not the true ones.

    Args:
        tracks: rows whose leaders were found by place.
    """
    if not len(tracks):
        return ()
    remarks = []
    for sign in _signs_of_missing_vehicles(tracks):
        remarks.append(Remark(f"{sign}: {_QUESTION}"))
    return tuple(remarks)


def _signs_of_missing_vehicles(tracks: Tracks) -> Iterator[str]:
    """Yields a sentence for each sign that vehicles are missing."""
    ahead, has_leader = rows_ahead(tracks)
    has_follower = np.zeros(len(tracks), dtype=bool)
    has_follower[ahead[has_leader]] = True
    starts, sizes = runs(tracks.recording, tracks.vehicle)
    last = starts + sizes - 1
    # Vehicles come in where a lane begins, behind all others, and leave it in front of all others.
    comes = starts[tracks.frame[starts] > tracks.frame.min()]
    leaves = last[tracks.frame[last] < tracks.frame.max()]
    for rows, has_neighbour, event in (
        (comes, has_follower, "appear in mid-road, ahead of another one"),
        (leaves, has_leader, "vanish in mid-road, behind another one"),
    ):
        count = int(np.count_nonzero(has_neighbour[rows]))
        if count >= _LEAST_VEHICLES and count >= _SHARE * len(rows):
            yield f"{count} of {len(rows)} vehicles {event}"
    is_free, acceleration = _free_moments(tracks, ahead, has_leader)
    drivers = len(np.unique(tracks.vehicle[is_free]))
    seconds = float(np.count_nonzero(is_free)) * tracks.dt
    if seconds < _LEAST_S or drivers < _LEAST_VEHICLES:
        return
    held_up = float(np.mean(acceleration[is_free] < _ACCELERATES_MPS2))
    if held_up >= _HELD_UP:
        yield (
            f"{drivers} vehicles drive slowly far behind a leader who is not slower, and in"
            f" {held_up:.0%} of {seconds:.0f} s do not accelerate, as if somebody were in between"
        )


def _free_moments(tracks: Tracks, ahead: Ints, has_leader: Marks) -> tuple[Marks, Floats]:
    """Returns the rows at which a driver could go faster, and their accelerations, `(N,)` each.

    The acceleration is the mean one of the next second, in the same lane behind the same leader,
    m/s2.
    """
    speed = tracks.speed
    gap = tracks.position[ahead] - tracks.length[ahead] - tracks.position
    is_free = has_leader & (gap > _FAR_S * speed + _FAR_M) & (speed[ahead] >= speed - 0.5)
    is_free &= speed < _SLOW * _desired_speeds(tracks)
    frames = max(1, round(1.0 / tracks.dt))
    later = np.minimum(np.arange(len(tracks)) + frames, len(tracks) - 1)
    is_free &= tracks.frame[later] - tracks.frame == frames
    for key in (tracks.recording, tracks.vehicle, tracks.lane, tracks.leader):
        is_free &= key[later] == key
    return is_free, (speed[later] - speed) / (frames * tracks.dt)


def _desired_speeds(tracks: Tracks) -> Floats:
    """Returns the desired speed of each row's vehicle in that lane, m/s."""
    stint = np.cumsum(changes(tracks.recording, tracks.vehicle, tracks.lane)) - 1
    order = np.lexsort((tracks.speed, stint))
    starts, sizes = runs(stint)
    at = starts + (_DESIRED * (sizes - 1)).astype(np.int64)
    speeds: Floats = tracks.speed[order][at][stint]
    return speeds
