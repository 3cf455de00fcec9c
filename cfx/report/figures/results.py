"""What a finished job has measured, as its figures read it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import pandas as pd

from cfx.evaluation.result import Purpose
from cfx.simulation.trajectory import TRANSIENT_S

if TYPE_CHECKING:
    from cfx.data.style import StyleResult
    from cfx.evaluation.result import Evaluation, PairTrajectory
    from cfx.evaluation.statistics import Improvement


@dataclass(frozen=True)
class ParameterAxis:
    """A tuned parameter: its name, its unit, and the bounds within which policies choose.

    `meaning` says in words what it is.
    """

    name: str
    unit: str = ""
    low: float | None = None
    high: float | None = None
    meaning: str = ""


def parameter_axes(evaluation: Evaluation) -> tuple[ParameterAxis, ...]:
    """Returns the tuned parameters of an evaluation."""
    axes = []
    for one in evaluation.parameters:
        axes.append(ParameterAxis(one.name, one.unit, one.low, one.high, one.meaning))
    return tuple(axes)


@dataclass(frozen=True)
class Results:
    """What a finished job has measured; a running job and a report make it, each of what it has.

    Attributes:
        pairs: a row per pair and method, as in `pairs.csv`.
        methods: those that are shown, in their order; without the policy if it does not adapt.
        parameters: the tuned ones.
        trajectories: test parts of all pairs; empty if none are known.
        improvements: of the policy by baseline; empty where that is not the job's purpose.
        style: of the drivers; None if it is not known. Without weights these are not known.
        tables: what the job has written, by name (`cfx.results.table`): of `curves`, `platoon`,
            `history`, `forecasts`, `slices`, `fits`, `labels` and those of plugins, what there is.
        metrics: of the job, under their names in `metrics.json`.
        transient_s: length of the transient at the beginning of the test part, s.
    """

    pairs: pd.DataFrame
    methods: tuple[str, ...]
    parameters: tuple[ParameterAxis, ...]
    trajectories: Sequence[PairTrajectory] = ()
    improvements: Mapping[str, Improvement] = field(default_factory=dict)
    style: StyleResult | None = None
    tables: Mapping[str, pd.DataFrame] = field(default_factory=dict)
    metrics: Mapping[str, float] = field(default_factory=dict)
    transient_s: float = TRANSIENT_S

    @classmethod
    def of(
        cls,
        evaluation: Evaluation,
        *,
        style: StyleResult | None = None,
        tables: Mapping[str, pd.DataFrame] | None = None,
        metrics: Mapping[str, float] | None = None,
    ) -> Results:
        """Returns the results of an evaluation and of the tables that a job has made.

        Args:
            evaluation: of the job.
            style: as in the attributes.
            tables: what the job has written, by name.
            metrics: as in the attributes; None: those of the evaluation alone.
        """
        shown = evaluation.distinct_methods()
        improvements: Mapping[str, Improvement] = {}
        if evaluation.purpose is Purpose.ADAPTATION:
            improvements = evaluation.improvements["test"]
        return cls(
            pairs=shown.table,
            methods=shown.methods,
            parameters=parameter_axes(evaluation),
            trajectories=evaluation.trajectories,
            improvements=improvements,
            style=style,
            tables=tables or {},
            metrics=evaluation.metrics() if metrics is None else metrics,
        )
