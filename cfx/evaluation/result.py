"""What an evaluation delivers: plain arrays and tables for tracking, figures and the console.

Shapes: K + 1 frames, n tuned parameters.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from cfx.calibration.identifiability import with_flat_shares
from cfx.core.parameters import Parameter
from cfx.evaluation.headline import improvement_key
from cfx.evaluation.metrics.base import RMSE_SPEED, SCOPES, LeftOut, MetricInfo
from cfx.evaluation.statistics import Improvement
from cfx.evaluation.tables import at_places, in_text, summaries, values_of, wide_table

if TYPE_CHECKING:
    from cfx.data.pairs import PairSet
    from cfx.data.style import StyleResult
    from cfx.models.base import DrivingModel
    from cfx.policies.base import Policy

Array = NDArray[np.float64]

_PAIRS_AT_ONCE = 1024
"""Pairs whose closed loops are in one table while they are written."""

_ROWS_AT_ONCE = 1 << 17
"""Rows of the long table that are text at once, while it is written."""

FORECAST = "forecast"
"""The scope of forecasts in the long table, and what their metrics begin with."""

METHODS = ("default", "pooled", "driver_specific", "shrunk", "policy")
"""What an evaluation may compare, in the order in which it is shown.

All start from the same measured state and are compared on the same frames.

`default`: the model's default parameters.
`pooled`: one set, calibrated jointly on the training drivers (pooled calibration), none of whom
is tested.
`driver_specific`: a set for each driver, calibrated on the first part of their own trajectory.
`shrunk`: that set shrunk towards the default and kept constant. A policy of offsets starts from it
where it is not `driver_specific` itself; it separates what adapting adds from what shrinking does.
`policy`: parameters that a policy chooses for each window.
"""


@dataclass(frozen=True)
class PairTrajectory:
    """One pair's test part; frame 0 is the last measured state before the simulation takes over.

    Attributes:
        pair_id: which pair.
        driver: its follower.
        time: `(K + 1,)` s, from the start of the pair.
        leader_speed, real_speed, real_gap: `(K + 1,)`, m/s and m, measured.
        speed, gap: per method, `(K + 1,)`, m/s and m, simulated.
        parameters: per method, `(K + 1, n)` in SI units: what held at each frame.
    """

    pair_id: str
    driver: str
    time: Array
    leader_speed: Array
    real_speed: Array
    real_gap: Array
    speed: Mapping[str, Array]
    gap: Mapping[str, Array]
    parameters: Mapping[str, Array]


_PLATOON_SUMMARIES = {
    "amplification": "mean",
    "head_to_tail": "mean",
    "string_stable": "mean",
    "settled": "mean",
    "min_gap": "min",
    "collisions": "sum",
    "hard_braking": "sum",
}
"""How measures of several networks become one metric."""


@dataclass(frozen=True)
class Platoon:
    """Platoons of followers behind a leader that brakes (`cfx.evaluation.platoon`).

    All followers of a platoon use the same method.

    Attributes:
        table: a row per method, network, vehicle and frame: method, network (which network or
            parameter set chooses the parameters), vehicle (0 is the leader), time_s, speed (m/s),
            gap (m; NaN for the leader).
        measures: a row per method and network: method, network, drop_leader, drop_first, drop_last
            (m/s, by how much the leader, the first and the last follower slow down), amplification
            (drop_last / drop_first), head_to_tail (drop_last / drop_leader), collisions (followers
            whose gap became negative; with one the two ratios are NaN), settled (1 if all followed
            steadily before the leader braked), string_stable (1 if no vehicle slows down more than
            the vehicle ahead, of those that settled and did not collide), and from the moment on at
            which the leader brakes min_gap (m) and hard_braking (frames with an acceleration below
            -8 m/s2).
    """

    table: pd.DataFrame
    measures: pd.DataFrame

    @property
    def methods(self) -> tuple[str, ...]:
        """The methods that were simulated, in the order of `METHODS`."""
        return _in_order(self.measures["method"])

    def metrics(self) -> dict[str, float]:
        """Returns `platoon/MEASURE/METHOD`.

        It is the mean over the method's networks, the least gap, and the sum of what is counted.
        """
        values: dict[str, float] = {}
        for column, summary in _PLATOON_SUMMARIES.items():
            aggregated = self.measures.groupby("method")[column].agg(summary)
            for method in self.methods:
                values[f"platoon/{column}/{method}"] = float(aggregated[method])
        return values


class Purpose(StrEnum):
    """What the numbers of a job say.

    `ADAPTATION`: whether a policy comes closer to drivers than constant parameters do.
    `CALIBRATION`: how close constant parameters come; the policy does not adapt them
    (`Policy.adapts`), and improves nothing.
    `POLICY`: how close the policy comes; with constant parameters the model follows no leader
    (`DrivingModel.has_constant_baseline`), so that there is nothing to compare with.
    """

    ADAPTATION = "adaptation"
    CALIBRATION = "calibration"
    POLICY = "policy"

    @classmethod
    def of(cls, model: DrivingModel, policy: Policy) -> Purpose:
        """Returns the purpose of a job with these components."""
        if not policy.adapts:
            return cls.CALIBRATION
        return cls.ADAPTATION if model.has_constant_baseline else cls.POLICY


@dataclass(frozen=True)
class Evaluation:
    """The comparison of all methods.

    `values` is the one table of what was measured; `table`, `metrics()` and `pair_metrics.parquet`
    are made of it.

    Metrics (`metrics`), under their names in metrics.json and MLflow; METHOD is one of `methods`:
        `METRIC/METHOD`: of the test part; `steady/METRIC/METHOD`: after its transient, during which
            the simulation still comes from the measured state; `full_trajectory/METRIC/METHOD`:
            from the first frame on, where that was simulated. `measured` says what each is, its
            unit, and how the pairs become one number. `METRIC/real`: the recorded drivers'.
        `improvement/METRIC/BASELINE/STATISTIC`: of the metric `judge`, see `Improvement`;
            `steady/...` and `full_trajectory/...` as above.
    Further tables bring metrics of their own (`cfx.results.table`).

    Attributes:
        about: a row per pair and method: pair_id, recording, leader_id, follower_id, driver,
            cluster, style_score, fold, method, frames (that count), and a column `parameter_NAME`
            with the mean of each tuned parameter over them; of `driver_specific` also `flat_NAME`,
            on which share of its range the loss is flat, where that was asked.
        values: a row per pair, method, scope and metric; see `cfx.evaluation.tables`.
        measured: the metrics, in the order in which they are shown.
        judge: name of the metric by which methods are compared: what was minimised.
        improvements: statistics of the policy's improvement of it, by scope (`test`; `steady`,
            after the transient, and `full_trajectory`, where there are any) and baseline.
        trajectories: the closed loops themselves, in the order of the pairs; those of a job are
            made when they are asked for.
        parameters: the tuned ones, in the bounds within which the policy chooses.
        purpose: what is compared.
        left_out: plugins' metrics that are broken.
        outside: how much of the test part, and of full trajectories, the policy drove outside what
            it has learned from, in words by scope; empty if it did not.
        platoon: ten followers in a row behind a braking leader; None if no network is for any
            driver.
        tables: further tables of the protocol, and those that the job adds, by name
            (`cfx.results.table`): of `curves`, `labels`, `sites`, `slices`, `fits` and those of
            plugins, what there is.
        notes: what the protocol says of its design (`ProtocolResult.notes`).
        recorded: the job's pairs, also those that were not tested; None: not known.
        style: the driving style of their drivers; None: not known.
    """

    about: pd.DataFrame
    values: pd.DataFrame
    measured: tuple[MetricInfo, ...]
    improvements: Mapping[str, Mapping[str, Improvement]]
    trajectories: Sequence[PairTrajectory]
    parameters: tuple[Parameter, ...]
    judge: str = RMSE_SPEED.name
    purpose: Purpose = Purpose.ADAPTATION
    left_out: tuple[LeftOut, ...] = ()
    outside: Mapping[str, str] = field(default_factory=dict)
    platoon: Platoon | None = None
    tables: Mapping[str, pd.DataFrame] = field(default_factory=dict)
    notes: Mapping[str, Any] = field(default_factory=dict)
    recorded: PairSet | None = None
    style: StyleResult | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """The tuned parameters' names."""
        return tuple(parameter.name for parameter in self.parameters)

    @cached_property
    def table(self) -> pd.DataFrame:
        """A row per pair and method, as in `pairs.csv`; see `wide_table`.

        With forecasts there are also the columns `forecast_METRIC`.
        """
        table = wide_table(self.about, self.values, self.measured, self.judge)
        forecast = self.values[self.values["scope"] == FORECAST]
        columns = {}
        for metric in forecast["metric"].unique():
            wide = values_of(forecast, metric, FORECAST)
            columns[f"{FORECAST}_{metric}"] = at_places(wide, table)
        return table.assign(**columns)

    @property
    def methods(self) -> tuple[str, ...]:
        """The methods that were compared, in the order of `METHODS`."""
        return _in_order(self.about["method"])

    def with_slices(self, slices: pd.DataFrame) -> Evaluation:
        """Returns the same results with the columns `flat_NAME`: see `with_flat_shares`."""
        return replace(self, about=with_flat_shares(self.about, slices, self.names))

    def distinct_methods(self) -> Evaluation:
        """Returns the same results without a policy that is one of the constant sets once more.

        A policy that does not adapt is one, unless something else acts beside its parameters.
        """
        is_calibration = self.purpose is Purpose.CALIBRATION and "policy" in self.methods
        if not is_calibration or not self._policy_repeats:
            return self
        about = self.about[self.about["method"] != "policy"].reset_index(drop=True)
        values = self.values[self.values["method"] != "policy"].reset_index(drop=True)
        platoon = self.platoon
        if platoon is not None:
            table, measures = platoon.table, platoon.measures
            platoon = Platoon(
                table[table["method"] != "policy"], measures[measures["method"] != "policy"]
            )
        return replace(self, about=about, values=values, platoon=platoon)

    @property
    def judge_info(self) -> MetricInfo:
        """The metric by which methods are compared."""
        for metric in self.measured:
            if metric.name == self.judge:
                return metric
        return RMSE_SPEED

    @property
    def _policy_repeats(self) -> bool:
        """Whether the policy has the errors of another method, for every pair."""
        speed = values_of(self.values, "rmse_speed", "test")
        for method in set(self.methods) - {"policy"}:
            if np.allclose(speed[method], speed["policy"], rtol=1e-6, atol=1e-9, equal_nan=True):
                return True
        return False

    def metrics(self) -> dict[str, float]:
        """Returns the metrics under their MLflow names."""
        values: dict[str, float] = {}
        for scope in SCOPES:
            improvements = self.improvements.get(scope, {})
            if scope == "test" or improvements:
                values |= summaries(self.values, self.measured, scope, self.methods)
            if "policy" not in self.methods:
                continue
            for baseline, improvement in improvements.items():
                prefix = improvement_key(self.judge, baseline, scope)
                for name, value in improvement.metrics().items():
                    values[f"{prefix}/{name}"] = value
        return values

    def values_tables(self) -> Iterator[pd.DataFrame]:
        """Yields `values` as it is written, some rows after the other."""
        for start in range(0, max(1, len(self.values)), _ROWS_AT_ONCE):
            yield in_text(self.values.iloc[start : start + _ROWS_AT_ONCE])

    def trajectories_table(self) -> pd.DataFrame:
        """Returns the closed loops in long form, SI units.

        Columns: pair_id, time_s, leader_speed, real_speed, real_gap; for each method speed_METHOD,
            gap_METHOD and, for each tuned parameter, NAME_METHOD. A pair's first row is the last
            measured state before the simulation takes over.
        """
        return pd.concat(self.trajectories_tables(), ignore_index=True)

    def trajectories_tables(self) -> Iterator[pd.DataFrame]:
        """Yields the same table, some pairs after the other."""
        for start in range(0, len(self.trajectories), _PAIRS_AT_ONCE):
            yield self._trajectories_of(self.trajectories[start : start + _PAIRS_AT_ONCE])

    def _trajectories_of(self, pieces: Sequence[PairTrajectory]) -> pd.DataFrame:
        """Returns the rows of some pairs of `trajectories_table`."""
        # Lists of arrays by column: one concatenation each is ten times as fast as a table a pair.
        parts: dict[str, list[Array]] = defaultdict(list)
        for piece in pieces:
            parts["pair_id"].append(np.full(len(piece.time), piece.pair_id, dtype=object))
            parts["time_s"].append(piece.time)
            parts["leader_speed"].append(piece.leader_speed)
            parts["real_speed"].append(piece.real_speed)
            parts["real_gap"].append(piece.real_gap)
            for method in self.methods:
                parts[f"speed_{method}"].append(piece.speed[method])
                parts[f"gap_{method}"].append(piece.gap[method])
                for k, name in enumerate(self.names):
                    parts[f"{name}_{method}"].append(piece.parameters[method][:, k])
        columns = {}
        for column, arrays in parts.items():
            columns[column] = np.concatenate(arrays)
        return pd.DataFrame(columns)


def _in_order(methods: pd.Series) -> tuple[str, ...]:
    """Returns the methods of a column, each once, in the order of `METHODS`."""
    compared = set(methods.unique())
    in_order = [method for method in METHODS if method in compared]
    return tuple(in_order)
