"""What figures show is chosen by rules that hold whatever the results are."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cfx.data.style import StyleResult
from cfx.evaluation.tables import scope_label
from cfx.figures.wording import common_prefix, shortened
from cfx.results.figures.improvement_bars import (
    WORST_WITHOUT_CUT,
    improvement_axis,
    improvement_bars,
)
from cfx.results.figures.pair_lines import evenly_spread, rank_pairs
from cfx.results.figures.parameter_spread import correlations, parameter_spreads, spread_offsets
from cfx.results.result import ParameterAxis
from cfx_report.figures.jobs import error_limit
from cfx_report.figures.style import draw_style
from cfx_report.runs import natural_order

GAIN = st.floats(-50, 1) | st.sampled_from([np.nan, -np.inf])
GAINS = st.lists(GAIN, min_size=1, max_size=30)


@given(GAINS)
def test_every_improvement_is_in_view_cut_off_or_counted(values: list[float]) -> None:
    ids = [f"p{k}" for k in range(len(values))]
    bars = improvement_bars(["job"], [ids], [np.array(values)])
    (series,) = bars.series
    assert len(series.values) + bars.undefined == len(values)
    assert (series.shown >= bars.axis.low).all()
    assert (series.shown <= bars.axis.high).all()
    assert (np.diff(series.values) <= 0).all()
    assert (series.values[series.clipped] < WORST_WITHOUT_CUT).all()
    assert bars.axis.low <= 0 <= bars.axis.high


@given(GAINS, st.integers(1, 6))
def test_ranked_pairs_go_from_the_best_to_the_worst(values: list[float], count: int) -> None:
    ids = [f"p{k}" for k in range(len(values))]
    ranked = rank_pairs(ids, np.array(values), count)
    gains = [one.improvement for one in ranked]
    known = [value for value in values if np.isfinite(value)]
    assert len(ranked) == min(count, len(known) or len(values))
    if known:
        assert gains == sorted(gains, reverse=True)
        if count > 1:
            assert (gains[0], gains[-1]) == (max(known), min(known))


def test_one_pair_and_the_middle_of_three_are_the_same_median() -> None:
    for available in range(3, 30):
        assert evenly_spread(available, 1)[0] == evenly_spread(available, 3)[1] == available // 2


def test_the_mean_stays_in_view_unless_it_dwarfs_the_bars() -> None:
    values = np.array([0.2, 0.1, 0.15, 0.1, 0.12, -8.0])
    near = improvement_axis(values, (-1.2,), baseline="driver_specific")
    far = improvement_axis(values, (-5.0,), baseline="driver_specific")
    assert near.low == pytest.approx(-1.2)
    assert far.low == pytest.approx(WORST_WITHOUT_CUT)
    assert "the lowest is \N{MINUS SIGN}800 %" in far.note


def test_a_default_far_off_does_not_stretch_the_errors() -> None:
    values = {"default": np.array([9.0, 0.4]), "policy": np.array([0.2, 0.3])}
    high, note = error_limit(values, "m/s")
    assert high == pytest.approx(1.6 * 0.3)
    assert note.startswith("1 job with default parameters further off, up to 9 m/s")


@pytest.mark.parametrize("scores", [[], [0.5], [0.5, 0.5, np.nan], [0.1, 0.9]])
def test_every_score_has_its_bin(scores: list[float]) -> None:
    table = pd.DataFrame({"score": np.array(scores, dtype=float), "cluster": 0})
    (axes,) = draw_style(StyleResult(table, {}, (float("nan"), 0.4))).axes
    counted = sum(bar.get_height() for bar in axes.patches)
    assert counted == int(np.isfinite(scores).sum())
    assert [text.get_text().strip() for text in axes.texts] == ["0.400"]
    assert ("without a score" in axes.get_xlabel()) == bool(np.isnan(scores).any())


def test_names() -> None:
    assert common_prefix(["i80-11-1", "i80-12-7"]) == "i80-"
    assert common_prefix(["one"]) == ""
    assert sorted(["a/11", "a/9"], key=natural_order) == ["a/9", "a/11"]
    assert scope_label("steady", 4.0) == "test part after the first 4 s"
    assert shortened("abcdefghij", 7) == "abc…hij"


def calibrated(values: list[float]) -> pd.DataFrame:
    """A table of pairs: driver-specific values of `tau`, `a` with the opposite order, defaults."""
    rows = []
    for value in values:
        rows.append(
            {"method": "driver_specific", "parameter_tau": value, "parameter_a": -(value**3)}
        )
        rows.append({"method": "default", "parameter_tau": 1.0, "parameter_a": 0.0})
        rows.append({"method": "pooled", "parameter_tau": 1.5, "parameter_a": 0.0})
    return pd.DataFrame(rows)


AXES = (ParameterAxis("tau", "s", 0.0, 4.0), ParameterAxis("a", "m/s2", -64.0, 0.0))


@given(st.lists(st.floats(0.0, 4.0), min_size=1, max_size=40))
def test_calibrated_values_lie_between_their_bounds_and_are_counted_there(
    values: list[float],
) -> None:
    tau, a = parameter_spreads(calibrated(values), AXES)
    places = tau.places(tau.values)
    np.testing.assert_allclose(places * 4.0, values)
    assert tau.at_low == np.mean([value < 0.04 for value in values])
    assert 0 <= tau.at_high <= 1 - tau.at_low
    assert (tau.default, list(tau.pooled), a.axis.unit) == (1.0, [1.5], "m/s2")


def test_parameters_without_bounds_or_values_are_left_out() -> None:
    unbounded = (ParameterAxis("tau", "s"), ParameterAxis("b", "s", 0.0, 1.0), AXES[1])
    assert [one.axis.name for one in parameter_spreads(calibrated([1.0]), unbounded)] == ["a"]
    nothing = calibrated([float("nan")])
    assert parameter_spreads(nothing, AXES) == ()


def test_correlations_are_of_ranks() -> None:
    table = correlations(calibrated([1.0, 2.0, 4.0, 3.0]), AXES)
    np.testing.assert_allclose(table.to_numpy(), [[1.0, -1.0], [-1.0, 1.0]])


@given(st.integers(0, 400))
def test_dots_spread_over_their_line(count: int) -> None:
    offsets = spread_offsets(count)
    assert offsets.shape == (count,)
    assert (np.abs(offsets) <= 1).all()
    assert len(np.unique(offsets)) == count
