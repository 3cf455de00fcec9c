"""What an evaluation delivers: plain arrays and tables that tracking, figures and the command line read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import pandas as pd
from numpy.typing import NDArray

Array = NDArray[np.float64]

METHODS = ("default", "population", "fixed", "shrunk", "policy")
"""What an evaluation may compare, in the order in which it is shown; always on the same frames from the same measured state.

`default`: the model's default parameters. `population`: one set calibrated jointly on the training drivers, none of whom is
tested. `fixed`: the driver's own set, from the first part of the drive. `base`: that set drawn towards the default, held: what a
policy of offsets starts from where that is not `fixed` itself, so that what adapting adds can be told from what drawing does.
`policy`: parameters that a policy chooses as it drives.
"""

STATISTICS = ("mean", "trimmed_mean", "median", "ci95_low", "ci95_high", "win_rate", "p_value")
"""What metrics tell of an `Improvement`."""


@dataclass(frozen=True)
class Drive:
    """One pair's test part: K + 1 frames, the first being the last measured state before the simulation takes over.

    Attributes:
        pair_id: which pair.
        driver: its follower.
        time: `(K + 1,)` s, from the start of the pair.
        leader_speed, real_speed, real_gap: `(K + 1,)`, measured.
        speed, gap: per method, `(K + 1,)`, simulated.
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


@dataclass(frozen=True)
class Improvement:
    """`(RMSE_baseline - RMSE_policy) / RMSE_baseline` of speed over the pairs, as fractions (0.1 is 10 %).

    Attributes:
        mean, trimmed_mean, median: over pairs; the trimmed mean drops the top and the bottom 10 %.
        ci95_low, ci95_high: bootstrap confidence interval of the mean; drivers are drawn, each with all his pairs.
        win_rate: share of pairs with a positive improvement.
        p_value: two-sided Wilcoxon signed-rank test of RMSE_baseline against RMSE_policy, means over each driver's pairs.
        pairs: number of pairs that count.
        undefined: number of pairs left out because RMSE_baseline is 0 or a rollout diverged.
        drivers: number of drivers of the pairs that count.
    """

    mean: float
    trimmed_mean: float
    median: float
    ci95_low: float
    ci95_high: float
    win_rate: float
    p_value: float
    pairs: int
    undefined: int
    drivers: int

    def metrics(self) -> dict[str, float]:
        """Returns the statistics by name."""
        return {name: float(getattr(self, name)) for name in STATISTICS}


_SAFETY_SUMMARIES = {
    "collisions": ("collisions", "sum"),
    "hard_braking": ("hard_braking", "sum"),
    "jerk": ("rms_jerk", "mean"),
    "at_bounds": ("at_bounds", "mean"),
}
"""Metrics of safety: the table's column, and how its pairs become one number."""

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
    """Platoons of one method's drivers each, behind a leader that brakes (`cfx.evaluation.platoon`).

    Attributes:
        table: a row per method, network, vehicle and frame: method, network (which network or parameter set drives), vehicle (0
            is the leader), time_s, speed (m/s), gap (m; NaN for the leader).
        measures: a row per method and network: method, network, drop_leader, drop_first, drop_last (m/s, by how much the
            leader, the first and the last follower slow down), amplification (drop_last / drop_first), head_to_tail
            (drop_last / drop_leader), collisions (followers whose gap became negative; with one the two ratios are NaN), settled
            (1 if all followed steadily before the leader braked), string_stable (1 if nobody slows down more than the vehicle
            ahead, of those that settled and did not collide), and from the moment on at which the leader brakes min_gap (m) and
            hard_braking (frames with an acceleration below -8 m/s2).
    """

    table: pd.DataFrame
    measures: pd.DataFrame

    @property
    def methods(self) -> tuple[str, ...]:
        """The methods that drove, in the order of `METHODS`."""
        present = set(self.measures["method"])
        return tuple(method for method in METHODS if method in present)

    def metrics(self) -> dict[str, float]:
        """Returns `platoon/MEASURE/METHOD`: over the method's networks the mean, the least gap, and sums of what is counted."""
        values: dict[str, float] = {}
        for column, summary in _PLATOON_SUMMARIES.items():
            found = self.measures.groupby("method")[column].agg(summary)
            values |= {
                f"platoon/{column}/{method}": float(found[method]) for method in self.methods
            }
        return values


@dataclass(frozen=True)
class Evaluation:
    """The comparison of all methods.

    Metrics (`metrics`), under their names in metrics.json and MLflow; METHOD is one of `methods`:
        `rmse_speed/METHOD`, `rmse_gap/METHOD`: m/s and m, means over pairs.
        `rmse_improvement/STATISTIC`, `rmse_improvement/BASELINE/STATISTIC`: see `Improvement`; against `fixed` unless told.
        `collisions/METHOD`: number of pairs. `hard_braking/METHOD`: number of frames with an acceleration below -8 m/s2.
        `jerk/METHOD`, `jerk/real`: m/s3, mean over pairs of the root mean square jerk; that of the recorded drivers.
        `at_bounds/METHOD`: share of the tuned parameters' values within 1 % of their range of a bound, mean over pairs.
        `steady/rmse_speed/METHOD`, `steady/rmse_improvement/BASELINE/STATISTIC`: the same beyond the first five seconds of the test
            part, where that is longer. At first a driver still comes from where he was measured.
        `full_trajectory/...`: the same over whole drives, where those were driven.
        `platoon/MEASURE/METHOD`: see `Platoon`.
        `history/BASE/AMOUNT/rmse_improvement`: see `history`; of "80 %" the name is `80pct`, of "10 s" `10s`.

    Attributes:
        table: a row per pair and method: pair_id, recording, leader_id, follower_id, driver, cluster, style_score, fold, method,
            frames, rmse_speed (m/s), rmse_gap (m), steady_rmse_speed (beyond the first five seconds; NaN if there is no more),
            improvement (against fixed, a fraction), `improvement_over_BASELINE` for the other baselines, collisions (1 if the gap
            became negative), hard_braking (frames with an acceleration below -8 m/s2), rms_jerk and real_rms_jerk (m/s3; of the
            simulated and of the recorded follower), at_bounds (share of the tuned parameters' values at a bound), and one column
            `parameter_NAME` with the mean of each tuned parameter; where whole drives were driven too, `full_trajectory_rmse_speed`,
            `full_trajectory_rmse_gap`, `full_trajectory_collisions` and `full_trajectory_hard_braking`.
        improvements: statistics of the policy's improvement over each baseline.
        drives: the closed loops themselves, in the order of the pairs.
        names: the tuned parameters' names.
        units: their units.
        bounds: `(2, n)`, those within which the policy chooses.
        whole_improvements: as `improvements`, over whole drives of drivers that nothing was fitted to; empty if there were none.
        platoon: ten drivers in a row behind a braking leader; None if no network is for any driver.
        history: what the policy gains from what it has read before it drives; None if that was not tried. A row per pair, base
            and amount: pair_id, driver, base (what the policy's answers are offsets from, `own` or `population`), history_s
            (seconds of measured history read before the test part), amount (the same in words, "10 s" or "80 %"), rmse_speed,
            rmse_gap, improvement (over the driver's own fixed parameters, a fraction).
        later_improvements: as `improvements`, beyond the first five seconds of the test part; empty if none is longer.
    """

    table: pd.DataFrame
    improvements: Mapping[str, Improvement]
    drives: tuple[Drive, ...]
    names: tuple[str, ...]
    units: tuple[str, ...]
    bounds: Array
    full_trajectory_improvements: Mapping[str, Improvement] = field(default_factory=dict)
    platoon: Platoon | None = None
    history: pd.DataFrame | None = None
    steady_improvements: Mapping[str, Improvement] = field(default_factory=dict)

    @property
    def methods(self) -> tuple[str, ...]:
        """The methods that were compared, in the order of `METHODS`."""
        present = set(self.table["method"])
        return tuple(method for method in METHODS if method in present)

    @property
    def improvement(self) -> Improvement:
        """The policy's improvement over the driver's own fixed parameters."""
        return self.improvements["fixed"]

    def metrics(self) -> dict[str, float]:
        """Returns the metrics under their MLflow names."""
        by_method = self.table.groupby("method")
        values: dict[str, float] = {}
        for column in ("rmse_speed", "rmse_gap"):
            means = by_method[column].mean()
            values |= {f"{column}/{method}": float(means[method]) for method in self.methods}
        for baseline, improvement in self.improvements.items():
            prefix = "rmse_improvement" if baseline == "fixed" else f"rmse_improvement/{baseline}"
            values |= {f"{prefix}/{name}": value for name, value in improvement.metrics().items()}
        if self.steady_improvements:
            means = by_method["steady_rmse_speed"].mean()
            values |= {
                f"steady/rmse_speed/{method}": float(means[method]) for method in self.methods
            }
        for part, improvements in (
            ("steady", self.steady_improvements),
            ("full_trajectory", self.full_trajectory_improvements),
        ):
            for baseline, improvement in improvements.items():
                values |= {
                    f"{part}/rmse_improvement/{baseline}/{name}": v
                    for name, v in improvement.metrics().items()
                }
        values |= self._safety_metrics()
        if self.full_trajectory_improvements:
            for column in ("rmse_speed", "rmse_gap"):
                means = by_method[f"whole_{column}"].mean()
                values |= {
                    f"whole/{column}/{m}": float(means[m]) for m in self._full_trajectory_methods
                }
        if self.platoon is not None:
            values |= self.platoon.metrics()
        if self.history is not None:
            for (base, amount), gains in self.history.groupby(["base", "amount"])["improvement"]:
                name = str(amount).replace(" ", "").replace("%", "pct")
                values[f"history/{base}/{name}/rmse_improvement"] = float(gains.mean())
        return values

    @property
    def _full_trajectory_methods(self) -> tuple[str, ...]:
        return (*self.full_trajectory_improvements, "policy")

    def _safety_metrics(self) -> dict[str, float]:
        """Returns counts and means of what a protocol measured; one that makes its own table may leave all but collisions out."""
        by_method = self.table.groupby("method")
        values: dict[str, float] = {}
        for name, (column, summary) in _SAFETY_SUMMARIES.items():
            if column in self.table:
                found = by_method[column].agg(summary)
                values |= {f"{name}/{method}": float(found[method]) for method in self.methods}
        if "real_rms_jerk" in self.table:
            values["jerk/real"] = float(
                self.table.drop_duplicates("pair_id")["real_rms_jerk"].mean()
            )
        for column in ("collisions", "hard_braking"):
            if self.full_trajectory_improvements and f"whole_{column}" in self.table:
                found = by_method[f"whole_{column}"].sum()
                values |= {
                    f"whole/{column}/{method}": float(found[method])
                    for method in self._full_trajectory_methods
                }
        return values

    def trajectories_table(self) -> pd.DataFrame:
        """Returns the closed loops in long form, SI units.

        Columns: pair_id, time_s, leader_speed, real_speed, real_gap; for each method speed_METHOD, gap_METHOD and, for each tuned
        parameter, NAME_METHOD. A pair's first row is the last measured state before the simulation takes over.
        """
        return pd.concat(
            [self._trajectory_table(drive) for drive in self.drives], ignore_index=True
        )

    def _trajectory_table(self, drive: Drive) -> pd.DataFrame:
        columns: dict[str, object] = {
            "pair_id": drive.pair_id,
            "time_s": drive.time,
            "leader_speed": drive.leader_speed,
            "real_speed": drive.real_speed,
            "real_gap": drive.real_gap,
        }
        for method in self.methods:
            columns |= {f"speed_{method}": drive.speed[method], f"gap_{method}": drive.gap[method]}
            columns |= {
                f"{name}_{method}": drive.parameters[method][:, k]
                for k, name in enumerate(self.names)
            }
        return pd.DataFrame(columns)
