from __future__ import annotations

import dataclasses
import math

import numpy as np
import pandas as pd
import pytest
import torch

from cfx.evaluation.closed_loop import ClosedLoop
from cfx.evaluation.metrics import evaluate, mean_interval
from cfx.evaluation.safety import Safety
from cfx.models.krauss import Krauss
from cfx.pairs import PairBatch
from cfx.parameters import Parameter, ParameterSpace
from cfx.style.result import StyleResult
from tests.drives import straight_pairs
from tests.made_up import GAINS, make_history, make_results

SPACE = ParameterSpace.of(
    Parameter("t", "s", 0.0, 10.0, 1.0, "time"),
    Parameter("a", "m/s2", 1.0, 2.0, 1.5, "acceleration"),
)


def loop(
    speed: list[float], *, counted: int | None = None, parameters: tuple[float, float] = (5.0, 1.5)
) -> ClosedLoop:
    """A drive of one pair; of its frames but the first, the first `counted` count."""
    count = len(speed)
    frames = torch.arange(count)
    counts = (frames > 0) & (frames <= (count if counted is None else counted))
    values = torch.tensor(parameters, dtype=torch.float64).expand(1, count, 2)
    return ClosedLoop(
        torch.tensor([speed], dtype=torch.float64),
        torch.full((1, count), 20.0).double(),
        values,
        counts[None],
    )


def test_an_acceleration_below_minus_8_is_hard_braking() -> None:
    # -7.9, -8.1, -9 and +9 m/s2 at 0.1 s.
    speed = [20.0, 19.21, 18.4, 17.5, 18.4]
    assert Safety.of(loop(speed), SPACE, 0.1).hard_braking.tolist() == [2]
    assert Safety.of(loop(speed, counted=2), SPACE, 0.1).hard_braking.tolist() == [1]


def test_jerk_is_the_change_of_the_simulated_acceleration() -> None:
    # a = 2t has a jerk of 2 m/s3; the second has accelerations 1, -1, 1: jerks of 20 and -20.
    time = 0.1 * np.arange(40)
    assert Safety.of(loop([float(t**2) for t in time]), SPACE, 0.1).rms_jerk == pytest.approx([2.0])
    assert Safety.of(loop([10.0, 10.1, 10.0, 10.1]), SPACE, 0.1).rms_jerk == pytest.approx([20.0])
    # Beyond the pair's end nothing counts, and a single frame has no jerk.
    assert Safety.of(
        loop([10.0, 10.1, 10.0, 10.1, 99.0], counted=3), SPACE, 0.1
    ).rms_jerk == pytest.approx([20.0])
    assert math.isnan(Safety.of(loop([10.0, 10.1, 10.0], counted=1), SPACE, 0.1).rms_jerk[0])


@pytest.mark.parametrize(
    ("parameters", "share"),
    [
        ((5.0, 1.5), 0.0),
        ((0.09, 1.5), 0.5),
        ((0.11, 1.5), 0.0),
        ((9.95, 1.995), 1.0),
        ((0.0, 1.0), 1.0),
    ],
)
def test_a_value_within_a_hundredth_of_the_range_is_at_the_bound(
    parameters: tuple[float, float], share: float
) -> None:
    assert Safety.of(
        loop([10.0] * 5, parameters=parameters), SPACE, 0.1
    ).at_bounds == pytest.approx([share])


def test_the_table_and_the_metrics_tell_what_was_driven() -> None:
    pairs = straight_pairs([30, 40])
    batch = PairBatch.of(pairs)
    first = torch.tensor([19, 19])
    model = Krauss()
    steady = torch.full((2, 21), 10.0).double()
    counted = (first[:, None] + torch.arange(21) < batch.lengths[:, None]) & (torch.arange(21) > 0)
    middle = model.space.from_unit(torch.full((2, 21, 2), 0.5).double())
    calm = ClosedLoop(steady, steady + 10, middle, counted)
    braked = steady.clone()
    braked[0, 5:] = (
        9.0  # one frame at -10 m/s2; the second pair brakes after its end has been reached by nobody
    )
    braked[0, 15:] = 1.0  # the first pair has ended by then
    hard = calm._replace(
        speed=braked, parameters=torch.where(torch.arange(2) == 0, model.space.bounds()[0], middle)
    )
    style = StyleResult(
        pd.DataFrame({"driver": [p.driver for p in pairs], "score": [0.2, 0.8], "cluster": [0, 2]}),
        {},
        (0.3, 0.7),
    )
    loops = {"default": calm, "fixed": calm, "policy": hard}
    found = evaluate(
        pairs,
        batch,
        first,
        loops,
        model.space,
        style,
        seed=0,
        whole={"default": calm, "policy": hard},
    )
    table = found.table.set_index(["pair_id", "method"])
    assert table["hard_braking"].to_dict() == {("p0", "policy"): 1} | dict.fromkeys(
        table.index.drop(("p0", "policy")), 0
    )
    assert table.loc[("p0", "policy"), "rms_jerk"] == pytest.approx(math.sqrt(2 * 100**2 / 9))
    assert table["real_rms_jerk"].to_numpy() == pytest.approx(0, abs=1e-9)
    metrics = found.metrics()
    assert (metrics["hard_braking/policy"], metrics["hard_braking/fixed"]) == (1, 0)
    assert metrics["jerk/policy"] == pytest.approx(math.sqrt(2 * 100**2 / 9) / 2)
    assert metrics["jerk/real"] == pytest.approx(0, abs=1e-9)
    assert (metrics["at_bounds/policy"], metrics["at_bounds/fixed"]) == (0.5, 0)
    assert (
        metrics["full_trajectory/hard_braking/policy"],
        metrics["full_trajectory/collisions/policy"],
    ) == (1, 0)
    assert "full_trajectory/collisions/fixed" not in metrics
    adaptation_space = model.space.for_adaptation(
        {model.space.names[0]: (-5.0, 5.0)}
    )  # then the policy's value is none of its bounds
    within = evaluate(
        pairs,
        batch,
        first,
        {**loops, "fixed": hard},
        model.space,
        style,
        seed=0,
        adaptation_space=adaptation_space,
    ).metrics()
    assert (within["at_bounds/policy"], within["at_bounds/fixed"]) == (0, 0.5)


def test_a_table_without_these_columns_still_has_its_other_metrics() -> None:
    metrics = make_results(pairs=3, frames=20).evaluation.metrics()
    assert "collisions/policy" in metrics
    assert not [name for name in metrics if name.startswith(("jerk", "at_bounds", "hard_braking"))]


def test_the_gain_from_history_has_metrics_under_names_without_spaces() -> None:
    evaluation = make_results(pairs=4, frames=20).evaluation
    metrics = dataclasses.replace(
        evaluation, history=make_history(evaluation.drives, GAINS)
    ).metrics()
    found = {name: value for name, value in metrics.items() if name.startswith("history/")}
    assert found == {
        "history/own/0s/rmse_improvement": pytest.approx(-0.1),
        "history/own/10s/rmse_improvement": pytest.approx(0.1),
        "history/own/80pct/rmse_improvement": pytest.approx(0.2),
        "history/population/80pct/rmse_improvement": pytest.approx(0.05),
    }


def test_a_mean_has_an_interval_over_drivers() -> None:
    values = [0.1, 0.3, 0.2, math.nan, 0.4]
    mean, low, high = mean_interval(values, ["a", "b", "c", "d", "e"], seed=0)
    assert mean == pytest.approx(0.25)
    assert low < mean < high
    assert math.isnan(mean_interval(values, ["a"] * 5, seed=0)[1])
    assert all(math.isnan(value) for value in mean_interval([math.nan], ["a"], seed=0))
