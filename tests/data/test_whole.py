"""Where leaders are the next in the lane, it is said if vehicles are missing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cfx.data.tracks import Tracks, next_in_lane
from cfx.data.whole import remarks_on_leaders
from tests.data.layouts import NONE, tracks_of

FRAMES = 600


def traffic(lanes: int = 4) -> Tracks:
    """Three vehicles in each lane; the second one is slow for half a minute, the third behind it."""
    slow = np.where(np.arange(FRAMES) < FRAMES // 2, 10.0, 20.0)
    rows, speeds = [], []
    for lane in range(lanes):
        for place, speed in enumerate((np.full(FRAMES, 20.0), slow, slow)):
            position = 100.0 - 25.0 * place + np.cumsum(speed) * 0.1
            vehicle = 3 * lane + place + 1
            rows += [(vehicle, frame, lane, NONE, position[frame]) for frame in range(FRAMES)]
            speeds.append(speed)
    return behind_the_next(tracks_of(rows, speed=np.concatenate(speeds)))


def behind_the_next(tracks: Tracks) -> Tracks:
    ahead, has_leader = next_in_lane(tracks)
    return replace(tracks, leader=np.where(has_leader, tracks.vehicle[ahead], NONE))


def without(tracks: Tracks, left_out: np.ndarray) -> Tracks:
    return behind_the_next(tracks.take(~left_out))


def test_a_driver_who_follows_nobody_who_is_recorded_is_said() -> None:
    tracks = traffic()
    missing = without(tracks, tracks.vehicle % 3 == 2)
    (remark,) = remarks_on_leaders(missing)
    assert "4 vehicles drive slowly far behind a leader who is not slower, and in 9" in remark.text
    assert "are all vehicles recorded?" in remark.text
    assert not remark.is_contradiction


def test_a_whole_recording_and_one_of_free_drivers_are_not() -> None:
    tracks = traffic()
    # Without the two behind, the first ones are alone; without the first ones, nobody is far ahead.
    assert remarks_on_leaders(without(tracks, tracks.vehicle % 3 != 1)) == ()
    assert remarks_on_leaders(without(tracks, tracks.vehicle % 3 == 1)) == ()
    assert remarks_on_leaders(tracks_of([])) == ()


@pytest.mark.parametrize(("late", "does"), [(True, "appear in mid-road"), (False, "vanish in mid")])
def test_vehicles_that_appear_and_vanish_in_mid_road_are_said(late: bool, does: str) -> None:
    tracks = traffic()
    is_first_half = tracks.frame < FRAMES // 2
    middle = tracks.vehicle % 3 == 2
    remarks = remarks_on_leaders(without(tracks, middle & (is_first_half == late)))
    assert [does in remark.text for remark in remarks].count(True) == 1
