"""The entropy weight method."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.stats import entropy

from cfx.core.component import validate
from cfx.data.pairs import Pair, PairSet
from cfx.data.style import (
    INDICATORS,
    StyleSettings,
    entropies,
    entropy_weights,
    indicators,
    measure_style,
    normalise,
    select_cluster,
)
from cfx.errors import ConfigError, DataError

# Whole numbers keep columns either constant or clearly spread: rounding itself is tested apart.
MATRICES = st.integers(1, 20).flatmap(
    lambda m: arrays(np.float64, (m, 6), elements=st.integers(-50, 50).map(float))
)


def a_pair(
    name: str, speed: object, headway: object = 20.0, driver: str = "", acceleration: object = 0.0
) -> Pair:
    speed = np.asarray(speed, dtype=float)
    position = np.cumsum(speed) * 0.1
    wave = np.broadcast_to(np.asarray(acceleration, dtype=float), speed.shape)
    return Pair(
        name,
        "r",
        "1",
        driver or name,
        0,
        0.1,
        5.0,
        position + headway,
        speed,
        wave,
        position,
        speed,
        wave,
    )


def some_pairs(count: int, seed: int = 0) -> PairSet:
    rng = np.random.default_rng(seed)
    return PairSet(
        tuple(
            a_pair(
                f"d{i}",
                rng.uniform(1, 20, 30),
                rng.uniform(8, 40),
                acceleration=rng.normal(0, rng.uniform(0.1, 2), 30),
            )
            for i in range(count)
        ),
        "made up",
    )


@given(MATRICES, st.sampled_from(["signed", "printed"]))
def test_weights_and_scores_keep_to_their_ranges(raw: np.ndarray, direction: str) -> None:
    normalised = normalise(raw, direction)
    weights = entropy_weights(normalised)
    assert np.isfinite(weights).all()
    assert (weights >= 0).all()
    assert weights.sum() == pytest.approx(1)
    assert normalised.min() >= 0
    assert normalised.max() <= 1
    scores = normalised @ weights
    assert scores.min() >= 0
    assert scores.max() <= 1 + 1e-12
    constant = np.ptp(raw, axis=0) == 0
    if not constant.all():
        assert (weights[constant] == 0).all()


@given(MATRICES, st.randoms(use_true_random=False))
def test_the_order_of_drivers_does_not_matter(raw: np.ndarray, random: object) -> None:
    order = np.array(sorted(range(len(raw)), key=lambda _: random.random()))  # type: ignore[attr-defined] # hypothesis' Random
    one, other = normalise(raw), normalise(raw[order])
    np.testing.assert_allclose(
        one[order] @ entropy_weights(one), other @ entropy_weights(other), atol=1e-9
    )


@given(
    MATRICES,
    arrays(np.float64, 6, elements=st.floats(0.01, 100)),
    arrays(np.float64, 6, elements=st.floats(-1000, 1000)),
)
def test_units_and_origins_do_not_matter(
    raw: np.ndarray, factor: np.ndarray, offset: np.ndarray
) -> None:
    one, other = normalise(raw), normalise(raw * factor + offset)
    np.testing.assert_allclose(one, other, atol=1e-6)
    np.testing.assert_allclose(entropy_weights(one), entropy_weights(other), atol=1e-4)


@given(MATRICES)
def test_entropy_is_shannons(raw: np.ndarray) -> None:
    assume(len(raw) > 1)
    normalised = normalise(raw)
    expected = [
        1.0 if not column.any() else entropy(column) / np.log(len(raw)) for column in normalised.T
    ]
    np.testing.assert_allclose(entropies(normalised), expected, atol=1e-9)


def test_a_case_computed_by_hand() -> None:
    """Three drivers, two columns that vary: speed 0, 1, 2 and space headway 10, 30, 20.

    The headway counts against aggressiveness.
    """
    raw = np.array([[0, 5, 0, 0, 10, 1], [1, 5, 0, 0, 30, 1], [2, 5, 0, 0, 20, 1]], dtype=float)
    normalised = normalise(raw)
    np.testing.assert_allclose(normalised[:, 0], [0, 0.5, 1])
    np.testing.assert_allclose(normalised[:, 4], [1, 0, 0.5])
    # Shares 1/3 and 2/3 in both: the same entropy, so half of the weight each.
    both = -(np.log(1 / 3) / 3 + 2 * np.log(2 / 3) / 3) / np.log(3)
    np.testing.assert_allclose(entropies(normalised), [both, 1, 1, 1, both, 1])
    np.testing.assert_allclose(entropy_weights(normalised), [0.5, 0, 0, 0, 0.5, 0])
    np.testing.assert_allclose(normalised @ entropy_weights(normalised), [0.5, 0.25, 0.75])


def test_printed_direction_goes_by_the_sign_of_the_value() -> None:
    raw = np.array([[-2.0], [0.0], [2.0]])
    np.testing.assert_allclose(normalise(raw, "printed")[:, 0], [1.0, 0.5, 1.0])
    np.testing.assert_allclose(normalise(raw, "signed")[:, 0], [0.0, 0.5, 1.0])
    headways = np.array([[0, 0, 0, 0, 10.0, 1], [0, 0, 0, 0, 30.0, 2]])
    np.testing.assert_allclose(normalise(headways, "printed")[:, 4:], [[0, 0], [1, 1]])
    np.testing.assert_allclose(normalise(headways, "signed")[:, 4:], [[1, 1], [0, 0]])


def test_a_spread_that_is_only_rounding_counts_as_none() -> None:
    raw = np.ones((4, 6))
    raw[:, 0] = [0.1 + 0.2, 0.3, 0.3, 0.3]
    np.testing.assert_array_equal(normalise(raw), 0)


def test_indicators_by_hand() -> None:
    one = a_pair(
        "a", [0.0, 2.0, 4.0], headway=np.array([6.0, 8.0, 12.0]), acceleration=[1.0, 2.0, 3.0]
    )
    row = indicators(PairSet((one,), "x")).iloc[0]
    assert row["mean_speed"] == pytest.approx(2.0)
    assert row["variance_speed"] == pytest.approx(8 / 3)
    assert row["mean_acceleration"] == pytest.approx(2.0)
    assert row["variance_acceleration"] == pytest.approx(2 / 3)
    assert row["mean_space_headway"] == pytest.approx(26 / 3)
    assert row["mean_time_headway"] == pytest.approx((8 / 2 + 12 / 4) / 2), (
        "the standing frame does not count"
    )
    assert (row["frames"], row["standing_frames"]) == (3, 1)


def test_pairs_of_one_driver_count_together() -> None:
    rng = np.random.default_rng(0)
    speed = rng.uniform(2, 9, 50)
    whole = PairSet((a_pair("a", speed), a_pair("b", speed[::2] + 1)), "x")
    cut = PairSet(
        (
            a_pair("a1", speed[:20], driver="a"),
            a_pair("b", speed[::2] + 1),
            a_pair("a2", speed[20:], driver="a"),
        ),
        "x",
    )
    one, other = indicators(whole), indicators(cut)
    assert list(one["driver"]) == list(other["driver"]) == ["r/a", "r/b"]
    np.testing.assert_allclose(one.drop(columns="driver"), other.drop(columns="driver"))


def test_a_driver_who_never_moves_has_a_headway() -> None:
    table = indicators(PairSet((a_pair("a", np.zeros(5), 8.0), a_pair("b", np.full(5, 10.0))), "x"))
    assert table["mean_time_headway"][0] == pytest.approx(16.0)
    assert np.isfinite(table.drop(columns="driver").to_numpy(dtype=float)).all()


def test_94_drivers_fall_into_clusters_as_in_the_paper() -> None:
    table = measure_style(some_pairs(94), StyleSettings()).table
    assert [int((table["cluster"] == k).sum()) for k in range(3)] == [24, 46, 24]
    assert set(table["cluster_name"][table["cluster"] == 2]) == {"aggressive"}


@given(st.integers(1, 40), st.integers(0, 5))
def test_clusters_follow_the_scores(drivers: int, seed: int) -> None:
    style = measure_style(some_pairs(drivers, seed), StyleSettings())
    table, (low, high) = style.table, style.cuts
    assert low <= high
    assert ((table["score"] < low) == (table["cluster"] == 0)).all()
    assert ((table["score"] > high) == (table["cluster"] == 2)).all()
    outer = [int((table["cluster"] == k).sum()) for k in (0, 2)]
    assert all(abs(count - drivers / 4) <= 1 for count in outer)


def test_equal_scores_share_a_cluster() -> None:
    alike = PairSet(tuple(a_pair(f"d{i}", np.full(9, 10.0)) for i in range(8)), "x")
    style = measure_style(alike, StyleSettings())
    assert set(style.table["cluster_name"]) == {"normal"}
    assert set(style.weights.values()) == {1 / 6}


def test_one_driver_is_normal() -> None:
    style = measure_style(some_pairs(1), StyleSettings())
    assert list(style.table["cluster_name"]) == ["normal"]
    assert np.isfinite(style.table["score"]).all()
    assert sum(style.weights.values()) == pytest.approx(1)


def test_faster_and_closer_is_more_aggressive() -> None:
    calm, keen = (
        a_pair("calm", np.linspace(5, 6, 30), 40.0),
        a_pair("keen", np.linspace(5, 25, 30), 10.0),
    )
    score = measure_style(PairSet((calm, keen), "x"), StyleSettings()).table.set_index("driver")[
        "score"
    ]
    assert score["r/keen"] > score["r/calm"]


def test_selecting_a_cluster_keeps_its_drivers_and_counts_the_others() -> None:
    pairs = some_pairs(20)
    style = measure_style(pairs, StyleSettings())
    kept = [select_cluster(pairs, style, name) for name in ("conservative", "normal", "aggressive")]
    assert sorted(pair.pair_id for part in kept for pair in part) == sorted(
        pair.pair_id for pair in pairs
    )
    for part in kept:
        assert len(part) + part.dropped[-1].count == 20
    assert select_cluster(pairs, style, "all") is pairs


def test_an_empty_cluster_says_so() -> None:
    pairs = some_pairs(1)
    with pytest.raises(
        DataError,
        match=r"style.cluster=aggressive: none of the 1 drivers .*"
        r"0 conservative, 1 normal, 0 aggressive",
    ):
        select_cluster(pairs, measure_style(pairs, StyleSettings()), "aggressive")
    with pytest.raises(DataError, match="no pairs"):
        measure_style(replace(pairs, pairs=()), StyleSettings())


@pytest.mark.parametrize(
    "options",
    [
        {"cluster": "angry"},
        {"percentiles": [75, 25]},
        {"percentiles": [0, 50]},
        {"direction": "up"},
    ],
)
def test_refuses_settings_that_make_no_sense(options: dict[str, object]) -> None:
    with pytest.raises(ConfigError, match="style"):
        validate(StyleSettings, options, where="style")


@pytest.mark.parametrize("direction", ["signed", "printed"])
def test_real_drivers(i80_pairs: PairSet, direction: str) -> None:
    style = measure_style(i80_pairs, StyleSettings(direction=direction))
    table = style.table
    assert len(table) == 221
    assert [int((table["cluster"] == k).sum()) for k in range(3)] == [55, 111, 55]
    assert np.isfinite(table[["score", *(i.name for i in INDICATORS)]].to_numpy(dtype=float)).all()
    means = table.groupby("cluster")["mean_time_headway"].mean()
    assert (means[0] > means[2]) == (direction == "signed"), (
        "the printed rule counts a long headway as aggressive"
    )
