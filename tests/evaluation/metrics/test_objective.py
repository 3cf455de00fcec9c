"""The error that a job is judged by: the metric that is its objective, or the objective itself."""

from __future__ import annotations

from dataclasses import replace

import pytest

from cfx.calibration.huber import SpeedHuber
from cfx.calibration.mixed import Mixed
from cfx.calibration.objectives import Objective
from cfx.calibration.rmse import GapRmse
from cfx.calibration.theil_u import TheilInequality
from cfx.evaluation.metrics.base import MetricSet, info_of
from cfx.evaluation.metrics.contract import trajectories
from cfx.evaluation.metrics.objective import judged_by

OTHERS = [SpeedHuber(), Mixed(), TheilInequality(signal="gap")]


@pytest.mark.parametrize(
    ("objective", "name"), [(GapRmse(), "rmse_gap"), (TheilInequality(), "theil_u")]
)
def test_an_objective_that_is_a_metric_comes_first(objective: Objective, name: str) -> None:
    metrics = judged_by(MetricSet.of(["rmse_speed"]), objective)
    assert metrics.judge == metrics.metrics[0].name == name


@pytest.mark.parametrize("objective", OTHERS, ids=lambda one: type(one).__name__)
def test_any_other_objective_is_measured_itself(objective: Objective) -> None:
    metrics = judged_by(MetricSet.own(), objective)
    judge = info_of(metrics.metrics[0], {"test"}, judges=True)
    assert (metrics.judge, judge.name, judge.unit) == ("objective", "objective", objective.unit)
    assert judge.headline
    drives = trajectories()
    metric = metrics.metrics[0].component
    assert bool((metric.compute(drives) > 0).all())
    perfect = replace(drives, speed=drives.measured_speed, gap=drives.measured_gap)
    assert metric.compute(perfect).tolist() == [0.0] * len(drives)
