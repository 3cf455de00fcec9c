"""From closed loops to the table of all metrics."""

from __future__ import annotations

import math

import pandas as pd
import pytest
import torch

from cfx.data.pairs import PairBatch
from cfx.data.style import StyleResult
from cfx.evaluation.closed_loop import ClosedLoop
from cfx.evaluation.evaluate import ComparedPairs, evaluate
from cfx.models.krauss import Krauss
from tests.drives import straight_pairs
from tests.made_up import make_results


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
    braked[0, 5:] = 9.0  # one frame at -10 m/s2
    braked[0, 15:] = 1.0  # the first pair has ended by then
    hard = calm._replace(
        speed=braked, parameters=torch.where(torch.arange(2) == 0, model.space.bounds()[1], middle)
    )
    style = StyleResult(
        pd.DataFrame({"driver": [p.driver for p in pairs], "score": [0.2, 0.8], "cluster": [0, 2]}),
        {},
        (0.3, 0.7),
    )
    loops = {"default": calm, "driver_specific": calm, "policy": hard}
    found = evaluate(
        ComparedPairs(pairs, batch, first, style),
        {"test": loops, "full_trajectory": {"default": calm, "policy": hard}},
        model.space,
    )
    table = found.table.set_index(["pair_id", "method"])
    assert table["hard_braking"].to_dict() == {("p0", "policy"): 1} | dict.fromkeys(
        table.index.drop(("p0", "policy")), 0
    )
    assert table.loc[("p0", "policy"), "jerk"] == pytest.approx(math.sqrt(2 * 100**2 / 9))
    assert table["real_jerk"].to_numpy() == pytest.approx(0, abs=1e-9)
    metrics = found.metrics()
    assert (metrics["hard_braking/policy"], metrics["hard_braking/driver_specific"]) == (1, 0)
    assert metrics["jerk/policy"] == pytest.approx(math.sqrt(2 * 100**2 / 9) / 2)
    assert metrics["jerk/real"] == pytest.approx(0, abs=1e-9)
    assert (metrics["at_bounds/policy"], metrics["at_bounds/driver_specific"]) == (0.5, 0)
    assert (
        metrics["full_trajectory/hard_braking/policy"],
        metrics["full_trajectory/collisions/policy"],
    ) == (1, 0)
    assert "full_trajectory/collisions/driver_specific" not in metrics
    adaptation_space = model.space.for_adaptation(
        {model.space.names[0]: (0.1, 20.0)}
    )  # then the policy's value is none of its bounds
    within = evaluate(
        ComparedPairs(pairs, batch, first, style),
        {"test": {**loops, "driver_specific": hard}},
        model.space,
        policy_space=adaptation_space,
    ).metrics()
    assert (within["at_bounds/policy"], within["at_bounds/driver_specific"]) == (0, 0.5)


def test_a_table_without_these_columns_still_has_its_other_metrics() -> None:
    metrics = make_results(pairs=3, frames=20).evaluation.metrics()
    assert "collisions/policy" in metrics
    assert not [name for name in metrics if name.startswith(("jerk", "at_bounds", "hard_braking"))]


def test_what_comes_after_the_start_is_measured_on_its_own() -> None:
    """Errors are 1 m/s in the first five seconds, then 0.5 (fixed) and 0.2 m/s (policy).

    One pair is shorter than that.
    """
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
    loops = {"driver_specific": loop(0.5), "policy": loop(0.2)}
    found = evaluate(ComparedPairs(pairs, batch, first, style), {"test": loops}, Krauss().space)
    table = found.table.set_index(["pair_id", "method"])["steady_rmse_speed"]
    assert table["p0"].to_dict() == pytest.approx({"driver_specific": 0.5, "policy": 0.2})
    assert table["p1"].isna().all()
    metrics = found.metrics()
    assert metrics["steady/rmse_speed/policy"] == pytest.approx(0.2)
    assert metrics["steady/improvement/rmse_speed/driver_specific/geometric"] == pytest.approx(0.6)
    assert found.improvements["steady"]["driver_specific"].undefined == 1
    alone = {
        method: ClosedLoop(*(values[1:] for values in one[:4])) for method, one in loops.items()
    }
    short = evaluate(
        ComparedPairs(pairs.select([False, True], "long"), batch[1:], first[1:], style),
        {"test": alone},
        Krauss().space,
    )
    assert not [name for name in short.metrics() if name.startswith("steady")]
