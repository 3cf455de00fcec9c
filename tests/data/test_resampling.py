"""Other time steps: the same drives, in other frames."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cfx.data.pairs import Dropped, Pair, PairSet
from cfx.data.resampling import resampled
from cfx.data.signals import RECORDED
from cfx.data.tidy import TidyDataset, write_tidy
from cfx.errors import ConfigError


def swinging(frames: int, dt: float, name: str = "a") -> Pair:
    """Two vehicles whose speeds swing by 2 m/s around 10 m/s in 12 s, the follower 1.2 s later."""
    time, turn = np.arange(frames) * dt, 2 * np.pi / 12

    def drive(t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return (
            10 * t - 2 / turn * np.cos(turn * t),
            10 + 2 * np.sin(turn * t),
            2 * turn * np.cos(turn * t),
        )

    leader, follower = drive(time), drive(time - 1.2)
    return Pair(name, "r", "1", name, 0, dt, 5.0, leader[0] + 8, *leader[1:], *follower, lane=3)


def of(*pairs: Pair) -> PairSet:
    return PairSet(pairs, "made up")


@pytest.mark.parametrize(
    ("recorded", "wanted"), [(0.04, 0.1), (0.1, 0.04), (0.1, 0.2), (1 / 30, 0.1), (0.12, 0.1)]
)
def test_drives_stay_what_they_are(recorded: float, wanted: float) -> None:
    (pair,) = resampled(of(swinging(1000, recorded)), wanted)
    expected = swinging(len(pair), wanted)
    assert pair.dt == wanted
    assert (len(pair) - 1) * wanted == pytest.approx(999 * recorded, abs=wanted)
    for name in RECORDED:
        # A monotone cubic flattens a peak: by half its curvature times the square of half a step at
        # most, and little elsewhere.
        np.testing.assert_allclose(
            getattr(pair, name),
            getattr(expected, name),
            atol=2 * (2 * np.pi / 12) ** 2 * recorded**2 / 8,
        )
    assert (pair.driver, pair.lane, pair.leader_length) == ("r/a", 3, 5.0)


def test_frames_that_both_steps_share_are_the_recorded_ones() -> None:
    pair = swinging(100, 0.05)
    (coarse,) = resampled(of(pair), 0.1)
    assert len(coarse) == 50
    for name in RECORDED:
        np.testing.assert_allclose(getattr(coarse, name), getattr(pair, name)[::2], rtol=1e-12)


def test_pairs_that_have_the_step_are_left_alone() -> None:
    pair = swinging(50, 0.1)
    (same,) = resampled(of(pair), 0.1)
    assert same is pair


@given(
    speeds=st.lists(st.floats(0, 40), min_size=3, max_size=30),
    recorded=st.floats(0.02, 0.5),
    wanted=st.floats(0.02, 0.5),
)
def test_nobody_reverses_or_is_faster_than_recorded(
    speeds: list[float], recorded: float, wanted: float
) -> None:
    speed = np.array(speeds)
    position = np.concatenate([[0.0], np.cumsum(speed[1:] * recorded)])
    zero = np.zeros(len(speed))
    pair = Pair(
        "a", "r", "1", "2", 0, recorded, 5.0, position + 30, speed, zero, position, speed, zero
    )
    for one in resampled(of(pair), wanted):
        assert one.follower_speed.min() >= speed.min() - 1e-9
        assert one.follower_speed.max() <= speed.max() + 1e-9
        assert (np.diff(one.follower_position) >= -1e-9).all()
        np.testing.assert_allclose(one.gap, 25, atol=1e-6)


def test_true_parameters_are_those_of_the_last_frame_before() -> None:
    pair = replace(
        swinging(6, 0.1),
        truth={"t_r": np.array([1.0, 1.0, 1.0, 2.0, 2.0, 2.0])},
        truth_model="krauss",
    )
    (fine,) = resampled(of(pair), 0.05)
    assert fine.truth["t_r"].tolist() == [1.0] * 6 + [2.0] * 5
    (coarse,) = resampled(of(pair), 0.2)
    assert coarse.truth["t_r"].tolist() == [1.0, 1.0, 2.0]


def test_what_is_too_short_is_counted() -> None:
    pairs = resampled(of(swinging(4, 0.1, "a"), swinging(30, 0.1, "b")), 0.5)
    assert [pair.pair_id for pair in pairs] == ["b"]
    assert pairs.dropped == (Dropped("shorter than two steps of 0.5 s", 1),)


def test_a_dataset_brings_files_of_different_steps_together(tmp_path: Path) -> None:
    files = [tmp_path / "fine.csv", tmp_path / "coarse.csv"]
    write_tidy(of(swinging(250, 0.04, "fine")), files[0])
    write_tidy(of(swinging(100, 0.1, "coarse")), files[1])
    pairs = TidyDataset(path=files, time_step=0.1).load()
    assert [(pair.pair_id, len(pair)) for pair in pairs] == [("fine", 100), ("coarse", 100)]
    assert pairs.dt == 0.1
    np.testing.assert_allclose(pairs[0].follower_speed, pairs[1].follower_speed, atol=1e-3)
    with pytest.raises(ConfigError, match=r"time_step"):
        TidyDataset(path=files, time_step=0)
