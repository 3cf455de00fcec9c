"""The objective of a job as a metric: what was minimised, on frames that were held out."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from cfx.calibration.objectives import FrameValues, Objective
from cfx.core import registry
from cfx.core.distributions import OWN
from cfx.core.registry import Installed
from cfx.evaluation.metrics.base import (
    OBJECTIVE,
    SCOPES,
    Metric,
    MetricSet,
    Trajectories,
    in_order,
    made,
)


class ObjectiveMetric(Metric):
    """The loss of each pair, for an objective that is no metric of its own.

    It is made with the objective, so that it has no entry point: its number depends on the
    objective's settings.
    """

    direction = "lower"
    scopes = SCOPES
    is_error = True
    order = 0

    def __init__(self, name: str, objective: Objective) -> None:
        """Takes an objective and the name under which it was chosen."""
        super().__init__()
        self._objective = objective
        self.unit = objective.unit  # type: ignore[misc]  # it is the objective's
        self.heading = f"objective {name}"  # type: ignore[misc]  # likewise
        self.meaning = f"the objective {name}, which was minimised"  # type: ignore[misc]  # likewise

    def compute(self, trajectories: Trajectories) -> Tensor:
        counted = trajectories.counted
        # What does not count may be NaN here, and must be finite for an objective.
        frames = FrameValues(
            speed=torch.where(counted, trajectories.speed, 0.0),
            gap=torch.where(counted, trajectories.gap, 0.0),
            measured_speed=torch.where(counted, trajectories.measured_speed, 0.0),
            measured_gap=torch.where(counted, trajectories.measured_gap, 0.0),
            dt=trajectories.dt,
        )
        return self._objective(frames, counted, dim=1)


def judged_by(chosen: MetricSet, objective: Objective) -> MetricSet:
    """Returns the metrics of a job with an objective, the error that it minimises first."""
    judge = objective.metric or OBJECTIVE
    metrics = {metric.name: metric for metric in chosen.metrics}
    if objective.metric and judge not in metrics:
        metrics[judge] = made(registry.entry("metric", judge))
    elif not objective.metric:
        brought_by = OWN if registry.is_own(objective) else registry.origin(objective)
        measured = ObjectiveMetric(registry.name_of(objective), objective)
        metrics[judge] = Installed("metric", judge, measured, brought_by)
    first = metrics.pop(judge)
    return replace(chosen, metrics=(first, *in_order(list(metrics.values()))), judge=judge)
