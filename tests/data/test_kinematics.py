"""Pairs whose signals contradict one another are named with the likely reason, and refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cfx.data.kinematics import contradiction, contradictions, typical_contradiction
from cfx.data.pairs import Pair, PairSet
from cfx.data.plausible import doubts
from cfx.data.signals import RECORDED
from cfx.data.tidy import TidyDataset
from cfx.data.tracks import distance_driven
from cfx.models.krauss import Krauss
from tests.checkout import ROOT
from tests.drives import straight_pairs, wavy_pairs

TRUE = torch.tensor([[1.0, 0.1], [2.0, 0.4], [3.0, 0.8], [1.5, 0.2]], dtype=torch.float64)
PAIRS = wavy_pairs(Krauss(), TRUE, frames=300)
SPEEDS = ("leader_speed", "follower_speed")
ACCELERATIONS = ("leader_acceleration", "follower_acceleration")
POSITIONS = ("leader_position", "follower_position")
FOOT, MILE_PER_HOUR = 0.3048, 0.44704


def times(factor: float, *signals: str, pair: Pair = PAIRS[0]) -> Pair:
    return replace(pair, **{name: getattr(pair, name) * factor for name in signals})


def by_gap(pair: Pair, speed: float, gap: float) -> Pair:
    """Returns what a file of gaps and speeds gives, each with a factor."""
    leader, follower = pair.leader_speed * speed, pair.follower_speed * speed
    rear = distance_driven(leader, pair.dt)
    return replace(
        pair,
        leader_length=0.0,
        leader_position=rear,
        follower_position=rear - pair.gap * gap,
        leader_speed=leader,
        follower_speed=follower,
        leader_acceleration=np.gradient(leader, pair.dt),
        follower_acceleration=np.gradient(follower, pair.dt),
    )


@pytest.mark.parametrize(
    ("pair", "said"),
    [
        (times(3.6, *SPEEDS), ["0.278 times speed times time", "km/h"]),
        (times(1 / FOOT, *SPEEDS), ["the speeds look like ft/s, not m/s"]),
        (times(1 / MILE_PER_HOUR, *SPEEDS), ["look like mph"]),
        (times(3.6, "follower_speed"), ["follower_position and follower_speed", "km/h"]),
        (times(1 / FOOT, *POSITIONS), ["3.28 times", "the positions look like ft"]),
        (times(100, *POSITIONS), ["positions look like cm"]),
        (times(1000, *POSITIONS), ["positions look like mm"]),
        (times(1 / 1.7, *POSITIONS), ["0.588 times", "positions must be in m"]),
        (times(-1, *POSITIONS), ["positions must grow"]),
        (times(-1, *ACCELERATIONS), ["their sign is turned"]),
        (times(2, *ACCELERATIONS), ["they are 2 times what the speeds say"]),
        (times(0.1, *ACCELERATIONS), ["they are 0.1 times what the speeds say"]),
        (times(1 / 9.80665, "follower_acceleration"), ["follower_acceleration", "look like g_0"]),
        (times(1 / FOOT, *ACCELERATIONS), ["ft/s2"]),
        (replace(PAIRS[0], dt=PAIRS[0].dt * 2), ["the time step looks like 0.1 s, not 0.2 s"]),
        (replace(PAIRS[0], dt=PAIRS[0].dt * 25 / 30), ["the time step looks like 0.1 s"]),
        (by_gap(PAIRS[1], 1 / MILE_PER_HOUR, 1.0), ["gap and speeds", "mph"]),
        (by_gap(PAIRS[1], 3.6, 1.0), ["gap and speeds", "km/h"]),
        (by_gap(PAIRS[1], 1.0, 1 / FOOT), ["the gaps look like ft"]),
    ],
)
def test_a_contradiction_is_named_with_its_likely_reason(pair: Pair, said: list[str]) -> None:
    found = contradiction(pair)
    assert found is not None
    for words in said:
        assert words in found.text()


@given(
    number=st.integers(0, len(PAIRS) - 1),
    signal=st.sampled_from([*SPEEDS, *ACCELERATIONS, *POSITIONS]),
    factor=st.sampled_from([3.6, 1 / MILE_PER_HOUR, 1 / FOOT, -1.0, 2.0, 0.1, 9.80665]),
)
@settings(deadline=None, max_examples=40)
def test_one_wrong_column_of_one_pair_is_found_and_no_other_pair(
    number: int, signal: str, factor: float
) -> None:
    wrong = list(PAIRS)
    wrong[number] = times(factor, signal, pair=wrong[number])
    found = dict(contradictions(PairSet(tuple(wrong), "made up")))
    assert list(found) == [wrong[number].pair_id]
    assert signal in found[wrong[number].pair_id].signals


def test_a_few_coarse_frames_say_nothing() -> None:
    """Accelerations of the step before, as SUMO has them, are others than those around a frame."""
    (coarse,) = straight_pairs([3]).pairs
    speed = np.array([21.02, 19.29, 19.41])
    signals = {"leader_speed": speed, "leader_acceleration": np.array([0.28, -1.73, 0.12])}
    position = 40.0 + np.cumsum(speed)
    assert contradiction(replace(coarse, dt=1.0, leader_position=position, **signals)) is None


def coarse_pair(rule: float, step: float = 1.0) -> Pair:
    """Returns a lively pair whose vehicles move by the new speed (1), its mean (0), the old (-1).

    Accelerations are those of the last step, as simulators write them.
    """
    generator = np.random.default_rng(5)
    (pair,) = straight_pairs([200]).pairs
    signals: dict[str, np.ndarray] = {}
    for who, ahead, late in (("leader", 60.0, 0), ("follower", 0.0, 2)):
        speed = 12.0 + np.sin(0.3 * (np.arange(200) - late)) + generator.uniform(-2, 2, 200)
        moved = 0.5 * (speed[1:] + speed[:-1]) + 0.5 * rule * np.diff(speed)
        signals[f"{who}_position"] = ahead + np.append(0.0, np.cumsum(moved * step))
        signals[f"{who}_speed"] = speed
        signals[f"{who}_acceleration"] = np.append(0.0, np.diff(speed) / step)
    return replace(pair, dt=step, **signals)


@pytest.mark.parametrize("rule", [1.0, 0.0, -1.0])
def test_a_source_may_integrate_by_a_rule_of_its_own(rule: float) -> None:
    pair = coarse_pair(rule)
    assert contradiction(pair) is None
    assert not [words for words in doubts(PairSet((pair,), "made up")) if "steps" in words]
    wrong = contradiction(times(3.6, "follower_speed", pair=pair))
    assert wrong is not None
    assert "km/h" in wrong.text()


def test_noise_between_coarse_frames_is_not_held_against_a_signal() -> None:
    """Accelerations that are differences of noisy speeds at 10 Hz, of which every tenth is kept."""
    generator = np.random.default_rng(7)
    time = np.arange(3000) * 0.1
    (pair,) = straight_pairs([300]).pairs
    signals = {}
    for who, late in (("leader", 0.0), ("follower", 1.0)):
        speed = 12.0 + 1.5 * np.sin(0.25 * (time - late)) + generator.normal(0, 0.06, len(time))
        position = 40.0 - 40.0 * late + np.cumsum(speed) * 0.1
        signals[f"{who}_speed"] = speed[::10]
        signals[f"{who}_acceleration"] = np.gradient(speed, 0.1)[::10]
        signals[f"{who}_position"] = position[::10]
    pair = replace(pair, dt=1.0, **signals)
    assert contradiction(pair) is None
    wrong = contradiction(times(-1, *ACCELERATIONS, pair=pair))
    assert wrong is not None
    assert "sign is turned" in wrong.text()


def test_differences_of_coarse_speeds_do_not_contradict_them() -> None:
    """Of many pairs alike, in each of which speeds change 6 % more than their differences say."""
    time = np.arange(200.0)
    (pair,) = straight_pairs([200]).pairs
    pairs = []
    for number in range(10):
        signals = {}
        for who, ahead in (("leader", 40.0), ("follower", 0.0)):
            speed = 12.0 + 2.0 * np.sin(0.5 * time + number)
            signals[f"{who}_speed"] = speed
            signals[f"{who}_acceleration"] = np.gradient(speed)
            signals[f"{who}_position"] = ahead + distance_driven(speed, 1.0)
        pairs.append(replace(pair, pair_id=f"p{number}", dt=1.0, **signals))
    assert typical_contradiction(PairSet(tuple(pairs), "made up")) is None
    wrong = [times(1.2, *ACCELERATIONS, pair=pair) for pair in pairs]
    assert typical_contradiction(PairSet(tuple(wrong), "made up")) is not None


def test_a_stationary_pair_says_nothing_and_is_let_through() -> None:
    still = replace(
        times(0.0, *SPEEDS, *ACCELERATIONS),
        leader_position=np.full(300, 20.0),
        follower_position=np.zeros(300),
    )
    assert contradiction(still) is None


SHARED = ROOT.parent / "shared" / "data"
THINNED = "openacc_ispra_low_speed_pairs.parquet"
"""Recordings with the noisiest accelerations: they are kept by half seconds and seconds, too."""


def every(step: int, pair: Pair) -> Pair:
    """Returns a pair of which every so many frames are kept."""
    signals = {name: getattr(pair, name)[::step] for name in RECORDED}
    return replace(pair, dt=pair.dt * step, **signals)


def check_thinned(pairs: PairSet) -> None:
    """Finds no contradiction in a recording of which every fifth or tenth frame is kept."""
    for step in (5, 10):
        thinned = pairs.changed(lambda pair, step=step: every(step, pair))
        assert not list(contradictions(thinned))
        assert typical_contradiction(thinned) is None


@pytest.mark.skipif(not SHARED.is_dir(), reason="the real recordings are not here")
@pytest.mark.parametrize("path", sorted(SHARED.glob("*.parquet")), ids=lambda path: path.name)
def test_real_recordings_are_let_through(path: Path) -> None:
    pairs = TidyDataset(path=path, min_duration=2, check="off", accelerations="recorded").load()
    assert not list(contradictions(pairs))
    if path.name == THINNED:
        check_thinned(pairs)


@pytest.mark.skipif(not SHARED.is_dir(), reason="the real recordings are not here")
def test_a_few_pairs_of_a_real_recording_are_let_through() -> None:
    path = SHARED / "openacc_zalazone_pairs.parquet"
    pairs = TidyDataset(path=path, min_duration=90, check="off", accelerations="recorded").load()
    for count in (4, 6, 8, 12):
        for first in range(0, len(pairs) - count, count):
            assert typical_contradiction(PairSet(pairs[first : first + count], "some")) is None
