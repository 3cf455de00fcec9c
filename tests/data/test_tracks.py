"""Pairs out of tracks: what makes a pair, what ends one, and that every row is accounted for."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cfx.data.pairs import PairSet
from cfx.data.tracks import Tracks, extract_pairs
from tests.data.layouts import NONE, driving, tracks_of

AHEAD = driving(1, range(20), lane=2, leader=NONE, at=100.0)


def ends(pairs: PairSet) -> dict[str, int]:
    return {one.reason: one.count for one in pairs.ends}


def left_out(pairs: PairSet) -> dict[str, int]:
    return {one.reason: one.count for one in pairs.dropped}


def test_a_pair_is_a_run_behind_one_leader() -> None:
    pairs = extract_pairs(tracks_of(AHEAD + driving(2, range(5, 15), 2, 1, 80.0)))
    (pair,) = pairs
    assert (pair.pair_id, pair.first_frame, len(pair), pair.lane) == ("r-2-1", 5, 10, 2)
    np.testing.assert_allclose(pair.gap, 15.0)
    assert left_out(pairs) == {"no vehicle ahead": 20}
    assert ends(pairs) == {"the follower's rows end or pause": 1}


def test_a_lane_change_of_the_follower_ends_a_pair() -> None:
    rows = driving(2, range(8), 2, 1, 80.0) + driving(2, range(8, 20), 3, NONE, 80.0)
    pairs = extract_pairs(tracks_of(AHEAD + rows))
    assert [len(pair) for pair in pairs] == [8]
    assert ends(pairs) == {"the follower changed lane": 1}


def test_a_lane_change_of_the_leader_ends_a_pair() -> None:
    leader = driving(1, range(8), 2, NONE, 100.0) + driving(1, range(8, 20), 3, NONE, 100.0)
    pairs = extract_pairs(tracks_of(leader + driving(2, range(20), 2, 1, 80.0)))
    assert [len(pair) for pair in pairs] == [8]
    assert ends(pairs) == {"the leader changed lane": 1}
    assert left_out(pairs)["the vehicle ahead is in another lane"] == 12


def test_a_cut_in_begins_a_pair_behind_another_leader() -> None:
    between = driving(3, range(8, 20), 2, 1, 90.0)
    behind = driving(2, range(8), 2, 1, 80.0) + driving(2, range(8, 20), 2, 3, 80.0)
    pairs = extract_pairs(tracks_of(AHEAD + between + behind))
    assert [(pair.pair_id, len(pair)) for pair in pairs] == [
        ("r-2-1", 8),
        ("r-2-3", 12),
        ("r-3-1", 12),
    ]
    assert ends(pairs) == {"another vehicle cut in": 1, "the follower's rows end or pause": 2}


def test_a_leader_that_leaves_the_recording_ends_a_pair() -> None:
    leader = driving(1, range(8), 2, NONE, 100.0)
    pairs = extract_pairs(tracks_of(leader + driving(2, range(20), 2, 1, 80.0)))
    assert ends(pairs) == {"the leader's rows end or pause": 1}
    assert left_out(pairs)["the vehicle ahead has no row at that frame"] == 12


def test_a_missing_frame_ends_a_pair_and_the_next_is_a_run_of_its_own() -> None:
    rows = driving(2, range(8), 2, 1, 80.0) + driving(2, range(10, 20), 2, 1, 80.0)
    pairs = extract_pairs(tracks_of(AHEAD + rows))
    assert [(pair.pair_id, len(pair)) for pair in pairs] == [("r-2-1", 8), ("r-2-1-run2", 10)]
    assert ends(pairs) == {"the follower's rows end or pause": 2}


def test_a_leader_farther_than_allowed_is_none() -> None:
    slow = [(2, k, 2, 1, 80.0) for k in range(20)]  # stands, so the gap is 15 m + 1 m a frame
    pairs = extract_pairs(tracks_of(AHEAD + slow), max_gap=20.0)
    assert [len(pair) for pair in pairs] == [6]
    assert float(pairs[0].gap.max()) == 20.0
    assert ends(pairs) == {"the leader went farther than 20 m": 1}
    assert left_out(pairs)["the leader is farther than 20 m"] == 14


def test_a_recorded_gap_replaces_positions_and_lanes() -> None:
    rows = driving(1, range(20), 7, NONE, 0.0) + driving(2, range(20), 2, 1, 0.0)
    gap = np.where(np.arange(40) < 20, np.nan, 12.5)
    (pair,) = extract_pairs(tracks_of(rows, gap=gap))
    np.testing.assert_allclose(pair.gap, 12.5)
    assert len(pair) == 20


def test_types_of_drivers_are_kept() -> None:
    rows = AHEAD + driving(2, range(20), 2, 1, 80.0)
    kinds = np.repeat([1, 0], 20)
    (pair,) = extract_pairs(tracks_of(rows, driver_type=kinds, driver_types=("acc", "human")))
    assert (pair.driver_type, pair.leader_driver_type) == ("acc", "human")


SECOND = range(40, 60)
"""Frames of a second recording."""

TWICE = [
    *AHEAD,
    *driving(2, range(20), lane=2, leader=1, at=80.0),
    *driving(1, SECOND, lane=2, leader=NONE, at=100.0),
    *driving(2, SECOND, lane=2, leader=1, at=80.0),
]
"""Vehicle 2 behind vehicle 1, twice: they could have been hidden for two seconds."""


@pytest.mark.parametrize("what", ["length", "vehicle_class", "position"])
def test_an_id_whose_length_class_or_way_breaks_is_two_vehicles(what: str) -> None:
    second = np.tile(np.arange(40) >= 20, 2)
    values = {"length": 5.0 + 3.0 * second, "vehicle_class": 1 * second}
    values["position"] = tracks_of(TWICE).position - 90.0 * second
    pairs = extract_pairs(tracks_of(TWICE, **{what: values[what]}))
    assert [pair.pair_id for pair in pairs] == ["r-2-1", "r-2-vehicle2-1-vehicle2"]
    assert len({pair.driver for pair in pairs}) == 2
    lengths = [5.0, 8.0 if what == "length" else 5.0]
    assert [pair.leader_length for pair in pairs] == lengths
    np.testing.assert_allclose(pairs[1].gap, 20.0 - lengths[1])
    (remark,) = pairs.remarks
    assert "2 ids stand for two vehicles or more (1, 2)" in remark.text


def test_an_id_that_comes_again_as_it_was_is_one_vehicle() -> None:
    pairs = extract_pairs(tracks_of(TWICE))
    assert [pair.pair_id for pair in pairs] == ["r-2-1", "r-2-1-run2"]
    assert not pairs.remarks
    second = np.tile(np.arange(40) >= 20, 2)
    again = tracks_of(TWICE, length=5.0 + 3.0 * second, ids_are_unique=True)
    assert not extract_pairs(again).remarks


def test_a_few_wrong_rows_make_no_other_vehicle() -> None:
    length = np.full(80, 5.0)
    length[[3, 50, 51]] = 9.0
    pairs = extract_pairs(tracks_of(TWICE, length=length))
    assert not pairs.remarks
    assert {pair.leader_length for pair in pairs} == {5.0}


def test_no_rows_make_no_pairs() -> None:
    pairs = extract_pairs(tracks_of([]))
    assert len(pairs) == 0
    assert pairs.dropped == pairs.ends == ()


ROW = st.tuples(
    st.integers(1, 4),
    st.integers(0, 11),
    st.integers(1, 2),
    st.integers(0, 4),
    st.integers(0, 40).map(float),
)
"""A vehicle, a frame, a lane, a leader, a position: few of each, so that rows meet."""


@given(rows=st.lists(ROW, max_size=60, unique_by=lambda row: row[:2]))
@settings(max_examples=80, deadline=None)
def test_pairs_are_what_a_plain_loop_finds(rows: list[Any]) -> None:
    tracks = tracks_of(rows)
    pairs = extract_pairs(tracks, max_gap=30.0)
    found = [
        (int(pair.follower_id), int(pair.leader_id), pair.first_frame, len(pair)) for pair in pairs
    ]
    assert found == plain(rows)
    in_pairs = sum(len(pair) for pair in pairs)
    assert in_pairs + sum(one.count for one in pairs.dropped) == len(tracks)
    assert sum(one.count for one in pairs.ends) == len(pairs)


def plain(rows: list[Any]) -> list[tuple[int, int, int, int]]:
    """Follower, leader, first frame and length of each pair, row by row."""
    at = {(vehicle, frame): (lane, leader, x) for vehicle, frame, lane, leader, x in rows}
    runs: list[list[Any]] = []
    for vehicle, frame in sorted(at):
        lane, leader, x = at[vehicle, frame]
        ahead = at.get((leader, frame))
        if ahead is None or ahead[0] != lane or not 0 < ahead[2] - 5.0 - x <= 30.0:
            continue
        key = (vehicle, leader, lane)
        if runs and runs[-1][0] == key and runs[-1][2] == frame - 1:
            runs[-1][2] = frame
        else:
            runs.append([key, frame, frame])
    found = []
    for (vehicle, leader, _), first, last in runs:
        if last > first:
            found.append((vehicle, leader, first, last - first + 1))
    return found


@pytest.mark.parametrize("wanted", ["vehicles", "len"])
def test_tracks_count_their_vehicles(wanted: str) -> None:
    tracks: Tracks = tracks_of(AHEAD + driving(2, range(5), 2, 1, 80.0))
    assert {"vehicles": tracks.vehicles, "len": len(tracks)}[wanted] == {"vehicles": 2, "len": 25}[
        wanted
    ]
