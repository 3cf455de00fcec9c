"""Steady following: the recorded relation of speed and gap."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cfx.data.pairs import Pair, PairBatch, PairSet
from cfx.data.steady import (
    VEHICLE_M,
    flow,
    relation_from,
    relation_of,
    relations_of_types,
    steady_following,
)
from tests.drives import straight_pairs


def steady(name: str, speed: float, gap: float, kind: str = "", seconds: float = 8.0) -> Pair:
    """A driver at constant speed and gap."""
    pair = straight_pairs([round(10 * seconds)], speed)[0]
    ahead = pair.follower_position + gap + pair.leader_length
    return replace(pair, pair_id=name, follower_id=name, leader_position=ahead, driver_type=kind)


def test_steady_frames_alone_are_averaged() -> None:
    """Frames at another speed than the leader's, of braking, and of under 3 s do not count."""
    calm = steady("calm", 10.0, 20.0)
    closing = replace(steady("closing", 10.0, 20.0), leader_speed=np.full(80, 9.0))
    braking = replace(steady("braking", 10.0, 20.0), follower_acceleration=np.full(80, -1.0))
    short = steady("short", 10.0, 20.0, seconds=2.5)
    found = steady_following(PairBatch.of([calm, closing, braking, short]))
    assert found.speed[0].nan_to_num().tolist() == pytest.approx([0, 0, 0, 10, 0, 0, 0, 0, 0])
    assert float(found.gap[0, 3]) == pytest.approx(20.0)
    assert bool(found.gap[1:].isnan().all())


def test_the_flow_of_a_lane_with_all_drivers() -> None:
    """Each driver counts once; the mean spacing is that of a lane which holds one of each."""
    gaps = (10.0, 20.0, 30.0)
    pairs = [steady(f"d{number}", 10.0, gap) for number, gap in enumerate(gaps)]
    again = replace(steady("again", 10.0, 30.0), follower_id="d2")
    pairs.append(again)
    found = steady_following(PairBatch.of(pairs))
    relation = relation_of(found, [pair.follower_id for pair in pairs])
    assert relation.drivers.tolist() == [3]
    assert relation.gap == pytest.approx([20.0])
    assert (relation.low[0], relation.median[0], relation.high[0]) == pytest.approx(gaps)
    assert flow(relation.speed, relation.gap)[0] == pytest.approx(3600 * 10 / (20 + VEHICLE_M))
    assert len(relation_of(found, ["one"] * 4).speed) == 0  # one driver is no relation


def test_gaps_between_recorded_speeds_and_types_apart() -> None:
    pairs = []
    for number in range(3):
        pairs.append(steady(f"slow{number}", 5.0, 10.0, "human"))
        pairs.append(steady(f"fast{number}", 10.0, 20.0, "human"))
        pairs.append(steady(f"car{number}", 10.0, 30.0, "acc"))
    relations = relations_of_types(PairSet(tuple(pairs), "test"))
    between = relations["human"].gap_at(np.array([4.0, 5.0, 7.5, 10.0, 11.0]))
    assert np.isnan(between[[0, 4]]).all()
    assert between[1:4] == pytest.approx([10.0, 15.0, 20.0])
    assert relations["acc"].gap == pytest.approx([30.0])
    read = relation_from(relations["human"].columns())
    np.testing.assert_allclose(read.gap, relations["human"].gap)
