from __future__ import annotations

import math

import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from cfx.evaluation.closed_loop import ClosedLoop
from cfx.evaluation.metrics import evaluate, improvement_statistics
from cfx.models.krauss import Krauss
from cfx.pairs import PairBatch
from cfx.style.result import StyleResult
from tests.drives import straight_pairs


def test_the_papers_pair() -> None:
    result = improvement_statistics(np.array([1.033]), np.array([0.666]), seed=0)
    assert result.mean == pytest.approx(0.355, abs=5e-4)
    assert math.isnan(result.ci95_low)


def test_the_interval_is_scipys_and_holds_the_mean() -> None:
    rng = np.random.default_rng(1)
    fixed = rng.uniform(0.5, 1.5, 40)
    policy = fixed * rng.uniform(0.7, 1.1, 40)
    result = improvement_statistics(fixed, policy, seed=0)
    assert result.ci95_low < result.mean < result.ci95_high
    # The normal approximation is no different at 40 pairs.
    gain = 1 - policy / fixed
    margin = 1.96 * gain.std(ddof=1) / math.sqrt(40)
    assert result.ci95_low == pytest.approx(gain.mean() - margin, abs=0.3 * margin)
    assert result.p_value == stats.wilcoxon(fixed, policy, zero_method="zsplit").pvalue
    assert result == improvement_statistics(fixed, policy, seed=0)


def test_no_difference_is_no_evidence() -> None:
    result = improvement_statistics(np.ones(10), np.ones(10), seed=0)
    assert (result.mean, result.win_rate, result.p_value, result.ci95_low, result.ci95_high) == (
        0,
        0,
        1,
        0,
        0,
    )


def test_undefined_pairs_are_counted() -> None:
    result = improvement_statistics(
        np.array([1.0, 0.0, np.nan, 2.0]), np.array([0.5, 0.1, 1.0, np.inf]), seed=0
    )
    assert (result.pairs, result.undefined, result.mean) == (1, 3, 0.5)


def test_pairs_of_one_driver_are_drawn_together() -> None:
    rng = np.random.default_rng(2)
    gain = rng.normal(0.1, 0.2, 12)
    fixed = np.ones(12)
    alone = improvement_statistics(fixed, 1 - gain, seed=0)
    # Ten copies of every pair tell nothing new about the drivers; taken for independent pairs, they would narrow the interval.
    drivers = [f"d{k}" for k in range(12)] * 10
    copied = improvement_statistics(np.tile(fixed, 10), np.tile(1 - gain, 10), drivers, seed=0)
    naive = improvement_statistics(np.tile(fixed, 10), np.tile(1 - gain, 10), seed=0)
    assert (copied.pairs, copied.drivers) == (120, 12)
    assert copied.mean == pytest.approx(alone.mean)
    assert copied.p_value == pytest.approx(alone.p_value)
    assert (copied.ci95_low, copied.ci95_high) == pytest.approx(
        (alone.ci95_low, alone.ci95_high), abs=0.01
    )  # other draws
    assert naive.ci95_high - naive.ci95_low < 0.5 * (copied.ci95_high - copied.ci95_low)


def test_a_single_driver_has_no_interval() -> None:
    result = improvement_statistics(np.ones(3), np.array([0.8, 0.9, 1.1]), ["a", "a", "a"], seed=0)
    assert math.isnan(result.ci95_low)
    assert (result.pairs, result.drivers) == (3, 1)


@given(st.lists(st.tuples(st.floats(0.01, 10), st.floats(0.01, 10)), min_size=2, max_size=12))
def test_nothing_is_invented(values: list[tuple[float, float]]) -> None:
    fixed, policy = np.array(values).T
    result = improvement_statistics(fixed, policy, seed=0)
    gain = (fixed - policy) / fixed
    assert gain.min() - 1e-9 <= result.ci95_low <= result.ci95_high <= gain.max() + 1e-9
    assert 0 <= result.p_value <= 1
    assert result.win_rate == (gain > 0).mean()


def test_what_comes_after_the_start_is_measured_on_its_own() -> None:
    """Errors of 1 m/s in the first five seconds, and of 0.5 (fixed) and 0.2 m/s (policy) from there on; one pair ends before."""
    pairs = straight_pairs([100, 45])
    batch, first = PairBatch.of(pairs), torch.tensor([9, 4])
    frames = torch.arange(91)
    counted = (first[:, None] + frames < batch.lengths[:, None]) & (frames > 0)
    parameters = Krauss().space.from_unit(torch.full((2, 91, 2), 0.5).double())

    def loop(steady: float) -> ClosedLoop:
        speed = 10 + torch.where(frames <= 50, 1.0, steady).double().expand(2, -1)
        return ClosedLoop(speed, speed + 10, parameters, counted)

    style = StyleResult(
        pd.DataFrame({"driver": [p.driver for p in pairs], "score": [0.2, 0.8], "cluster": [0, 2]}),
        {},
        (0.3, 0.7),
    )
    loops = {"fixed": loop(0.5), "policy": loop(0.2)}
    found = evaluate(pairs, batch, first, loops, Krauss().space, style, seed=0)
    table = found.table.set_index(["pair_id", "method"])["steady_rmse_speed"]
    assert table["p0"].to_dict() == pytest.approx({"fixed": 0.5, "policy": 0.2})
    assert table["p1"].isna().all()
    metrics = found.metrics()
    assert metrics["steady/rmse_speed/policy"] == pytest.approx(0.2)
    assert metrics["steady/rmse_improvement/fixed/mean"] == pytest.approx(0.6)
    assert found.steady_improvements["fixed"].undefined == 1
    alone = {method: ClosedLoop(*(values[1:] for values in one)) for method, one in loops.items()}
    short = evaluate(
        pairs.select([False, True], "long"),
        batch[1:],
        first[1:],
        alone,
        Krauss().space,
        style,
        seed=0,
    )
    assert not [name for name in short.metrics() if name.startswith("steady")]
