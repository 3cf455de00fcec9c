"""The tables of results that cfx's own protocols deliver, and that of results by site."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
import pandas as pd
from rich.console import RenderableType
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from cfx.calibration.identifiability import flat_for
from cfx.calibration.settings import (
    CORRELATED,
    DIVERGENT,
    ENOUGH,
    INTERVAL_LEVEL,
    MAX_PARETO_K,
    MIN_NARROWING,
    MIXED,
    OFF,
    UNLIKELY,
    are_contradicted,
    are_reliable,
)
from cfx.core.parameters import Parameter
from cfx.data.style import INDICATOR_NAMES, INDICATORS, style_distances, styles_by_site
from cfx.evaluation.metrics.base import MetricInfo
from cfx.evaluation.result import METHODS, Evaluation
from cfx.evaluation.sites import ALL_SITES, BASELINES
from cfx.evaluation.statistics import improvement_statistics
from cfx.evaluation.tables import scope_label
from cfx.figures.wording import short_label
from cfx.learners.curves import best_losses
from cfx.policies.context import LEVEL as EXPECTED_LEVEL
from cfx.results.table import Column, ResultTable

PAIR = Column("pair_id", "", "the pair of leader and follower", "text")
DRIVER = Column("driver", "", "the follower of the pair", "text")
METHOD = Column("method", "", "what chose the parameters", "text")
TIME = Column("time_s", "s", "time since the start of the pair")


class Pairs(ResultTable):
    """A row per pair and method: the metrics of the test part and beyond, and the parameters."""

    meaning = "a row per pair and method"
    suffix = ".csv"
    tracked = "table"
    order = 10
    always = True
    columns = (
        PAIR,
        Column("recording", "", "the recording that the pair is of", "text", required=False),
        Column("leader_id", "", "the leader, as the recording names it", "text", required=False),
        Column("follower_id", "", "the follower, likewise", "text", required=False),
        DRIVER,
        Column("cluster", "", "the cluster of the driver's style, by name", "text"),
        Column("style_score", "1", "the driver's style", required=False),
        Column("fold", "1", "which fold tested the driver", "int", required=False),
        METHOD,
        Column("frames", "1", "frames that count", "int"),
        Column("rmse_speed", "m/s", "RMSE of speed on the test part"),
        Column("rmse_gap", "m", "RMSE of the gap on the test part"),
        Column("collisions", "1", "1 if the gap became negative", "int"),
        Column("METRIC", "as of the metric", "another metric of the test part"),
        Column("improvement_over_METHOD", "1", "improvement over a method, of the job's error"),
        Column("steady_METRIC", "as of the metric", "a metric after the transient"),
        Column("full_trajectory_METRIC", "as of the metric", "a metric of the full trajectory"),
        Column("real_METRIC", "as of the metric", "a metric of the recorded driver"),
        Column("parameter_NAME", "as of the parameter", "mean of a parameter over the frames"),
        Column(
            "flat_NAME",
            "1",
            "of driver-specific parameters: on which share of the range the loss is within 5 %"
            " of its best; 1: the recording does not determine it",
        ),
        Column("forecast_METRIC", "as of the metric", "an error of the pair's forecasts"),
    )

    def rows(self, evaluation: Evaluation) -> Iterable[pd.DataFrame | None]:
        return [evaluation.table]

    def metrics(self, evaluation: Evaluation) -> dict[str, float]:
        shares = flat_for(evaluation.table, evaluation.names)
        return {f"flat/{name}": share for name, share in shares.items()}


class PairMetrics(ResultTable):
    """Every metric of every pair, method and part of the trajectories."""

    meaning = "a row per pair, method, scope and metric: what the tables are made from"
    order = 20
    large = True
    columns = (
        PAIR,
        Column("driver", "", "the follower of the pair", "text", required=False),
        Column("method", "", "what drove; `real` is the recorded driver", "text"),
        Column("scope", "", "the part of the trajectory", "text"),
        Column("metric", "", "the name of the metric", "text"),
        Column("value", "as of the metric", "NaN where it is not defined"),
    )

    def rows(self, evaluation: Evaluation) -> Iterable[pd.DataFrame | None]:
        return evaluation.values_tables()


class Trajectories(ResultTable):
    """What each method simulated on the test part, a row per frame.

    A pair's first row is the last measured state before the simulation takes over.
    """

    meaning = "what each method simulated"
    order = 30
    always = True
    large = True
    columns = (
        PAIR,
        TIME,
        Column("leader_speed", "m/s", "measured"),
        Column("real_speed", "m/s", "measured, of the follower"),
        Column("real_gap", "m", "measured"),
        Column("speed_METHOD", "m/s", "simulated, of the follower"),
        Column("gap_METHOD", "m", "simulated"),
        Column("NAME_METHOD", "as of the parameter", "a tuned parameter that held at the frame"),
    )

    def rows(self, evaluation: Evaluation) -> Iterable[pd.DataFrame | None]:
        return evaluation.trajectories_tables()


class Curves(ResultTable):
    """Learning curves; without rows where nothing was learned."""

    meaning = (
        "learning curves; of heads that draw also of how many sampled paths the CRPS is in an"
        " epoch's training loss"
    )
    order = 40
    always = True
    columns = (
        Column("network", "", "which of the networks", "text"),
        Column("epoch", "1", "from 0", "int"),
        Column("train_loss", "as of the loss", "mean over the training windows"),
        Column("validation_loss", "as of the loss", "mean over the validation windows"),
        Column("sampled_paths", "1", "paths per window in the CRPS", "int", required=False),
    )

    def metrics(self, evaluation: Evaluation) -> dict[str, float]:
        return best_losses(evaluation.tables["curves"])


def _indicator_columns(meaning: str, *, required: bool = True) -> list[Column]:
    """Returns a column for each indicator of driving style."""
    columns = []
    for indicator in INDICATORS:
        columns.append(Column(indicator.name, indicator.unit, meaning, required=required))
    return columns


class Style(ResultTable):
    """Driving style, a row per driver."""

    meaning = "driving style, a row per driver"
    suffix = ".csv"
    order = 50
    always = True
    columns = (
        DRIVER,
        Column("score", "1", "weighted sum of the indicators; large is aggressive"),
        Column("cluster", "1", "0, 1 or 2: conservative, normal, aggressive", "int"),
        Column("cluster_name", "", "the cluster by name", "text", required=False),
        *_indicator_columns("an indicator", required=False),
        Column("frames", "1", "frames of the driver", "int", required=False),
        Column("standing_frames", "1", "frames in which the driver stands", "int", required=False),
        Column("site", "", "the road or area; several are joined by `; `", "text", required=False),
        Column("driver_type", "", "what drives", "text", required=False),
    )

    def rows(self, evaluation: Evaluation) -> Iterable[pd.DataFrame | None]:
        return [] if evaluation.style is None else [evaluation.style.table]


class Labels(ResultTable):
    """Parameters that were calibrated window by window, for a learner that imitates them."""

    meaning = "per-window calibrated parameters (labels), with their loss and sensitivity"
    order = 60
    tracked = ""
    columns = (
        PAIR,
        Column("window", "1", "number of the window, from 0", "int", required=False),
        Column("time_s", "s", "start of the window, since the start of the pair"),
        Column("parameter_NAME", "as of the parameter", "what was calibrated"),
        Column("loss", "as of the objective", "the loss with these parameters"),
        Column("sensitivity", "as of the objective", "by how much the choice changes the loss"),
        Column("diverged", "1", "whether the simulation diverged", "bool", required=False),
    )


class Platoon(ResultTable):
    """Followers in a row behind a leader that brakes, a row per method, network and frame."""

    meaning = "ten such followers in a row behind a leader that brakes"
    order = 100
    columns = (
        METHOD,
        Column("network", "", "which network or parameter set chooses the parameters", "text"),
        Column("vehicle", "1", "0 is the leader", "int"),
        Column("time_s", "s", "since the start"),
        Column("speed", "m/s", "simulated"),
        Column("gap", "m", "simulated; NaN for the leader"),
    )

    def rows(self, evaluation: Evaluation) -> Iterable[pd.DataFrame | None]:
        platoon = evaluation.platoon
        return [None if platoon is None else platoon.table]

    def metrics(self, evaluation: Evaluation) -> dict[str, float]:
        platoon = evaluation.platoon
        return {} if platoon is None else platoon.metrics()


class History(ResultTable):
    """What the policy gains from its burn-in, a row per pair, base and amount of history."""

    meaning = "the improvement for different lengths of known history"
    order = 110
    columns = (
        PAIR,
        DRIVER,
        Column("base", "", "what the policy's answers are offsets from", "text"),
        Column("history_s", "s", "measured history before the test part that it has seen"),
        Column("amount", "", "the same in words, `10 s` or `80 %`", "text"),
        Column("rmse_speed", "m/s", "RMSE of speed on the test part"),
        Column("rmse_gap", "m", "RMSE of the gap on the test part"),
        Column("improvement", "1", "over driver-specific parameters"),
    )

    def metrics(self, evaluation: Evaluation) -> dict[str, float]:
        return history_metrics(evaluation.tables["history"])


class Slices(ResultTable):
    """The loss along each calibrated parameter, the others held."""

    meaning = (
        "the loss when one calibrated parameter is moved from bound to bound and the others are"
        " held"
    )
    order = 200
    columns = (
        PAIR,
        Column("parameter", "", "which is moved", "text"),
        Column("place", "1", "0 at the lower bound, 1 at the upper, as it is calibrated"),
        Column("value", "as of the parameter", "the parameter there"),
        Column("loss", "as of the objective", "the loss there, without the prior"),
        Column("best_loss", "as of the objective", "the loss with the calibrated parameters"),
    )


_NOISE = {
    "trajectory": "errors of a whole trajectory, which last for seconds",
    "measurement": "white errors of the measurement",
    "acceleration": "the driver's acceleration, which differs from the model's",
    "both": "the driver's acceleration and errors of the measurement",
}


def noise_evidence(tables: Mapping[str, pd.DataFrame]) -> dict[str, float]:
    """Returns the log evidence of each kind of noise, of all pairs together.

    Args:
        tables: of a job; without `noise` there is none.
    """
    if "noise" not in tables:
        return {}
    totals = tables["noise"].groupby("noise")["log_evidence"].sum()
    return dict(zip(totals.index.astype(str), totals.astype(float), strict=True))


@dataclass(frozen=True)
class KnownParameters:
    """What a job's fits say of how well drivers' parameters are known.

    Attributes:
        rows: the posterior's columns, a row per pair.
        parameters: those that were calibrated.
        evidence: log evidence of each kind of noise that was tried, of all pairs together; empty
            where the posterior knows one alone.
    """

    rows: pd.DataFrame
    parameters: tuple[Parameter, ...]
    evidence: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def of(cls, evaluation: Evaluation) -> KnownParameters | None:
        """Returns them; None where the job asked for no posterior."""
        fits = evaluation.tables.get("fits")
        if fits is None or "noise_scale" not in fits:
            return None
        tuned = []
        for parameter in evaluation.parameters:
            if f"median_{parameter.name}" in fits:
                tuned.append(parameter)
        evidence = noise_evidence(evaluation.tables)
        return cls(fits[fits["method"] == "driver_specific"], tuple(tuned), evidence)

    @property
    def reliable(self) -> pd.Series:
        """Whether a pair's intervals are to be relied on."""
        return are_reliable(self.rows)

    def determined(self, name: str) -> int:
        """Returns how many pairs' recordings determine a parameter, as far as that is known."""
        return int(((self.rows[f"contraction_{name}"] >= MIN_NARROWING) & self.reliable).sum())

    def metrics(self) -> dict[str, float]:
        """Returns what MLflow keeps too.

        `posterior/determined/NAME`, `posterior/reliable` and `posterior/contradicted` are shares of
        pairs, `posterior/held` is the mean over pairs, `posterior/noise_left`,
        `posterior/effective_samples` and `posterior/expected_coverage` (`sbi`) are medians.
        """
        values = {}
        for parameter in self.parameters:
            share = self.determined(parameter.name) / len(self.rows)
            values[f"posterior/determined/{parameter.name}"] = share
        values["posterior/reliable"] = float(self.reliable.mean())
        for name in ("noise_left", "effective_samples", "expected_coverage"):
            if name in self.rows:
                values[f"posterior/{name}"] = float(self.rows[name].median())
        if self.checked:
            values["posterior/held"] = float(self.rows["held"].mean())
            values["posterior/contradicted"] = float(are_contradicted(self.rows).mean())
        return values

    @property
    def checked(self) -> bool:
        """Whether forecasts were compared with held-out parts."""
        return "held" in self.rows and bool(self.rows["held"].notna().any())

    def printed(self) -> list[RenderableType]:
        """Returns the table of parameters, then what is not determined, then a warning if due."""
        pairs = len(self.rows)
        words = "" if pairs == 1 else f", median of {pairs} pairs"
        table = Table(
            title=f"What the recordings say of parameters{words}: {INTERVAL_LEVEL:.0%} intervals",
            title_justify="left",
        )
        table.add_column("parameter")
        table.add_column("interval", justify="right")
        table.add_column("determined for", justify="right")
        undetermined = []
        for parameter in self.parameters:
            name = parameter.name
            columns = [f"median_{name}", f"low_{name}", f"high_{name}"]
            middle, low, high = self.rows[columns].median()
            unit = "" if parameter.unit == "1" else f" {parameter.unit}"
            interval = f"{middle:.3g}{unit} ({low:.3g} to {high:.3g})"
            determined = self.determined(name)
            table.add_row(name, interval, f"{determined} of {pairs}")
            if determined < self.reliable.sum():
                undetermined.append(f"{name} for {self.reliable.sum() - determined}")
        sentences = self._doubts()
        if undetermined:
            sentences.append(
                f"Hardly known after these recordings: {', '.join(undetermined)} of {pairs} pairs"
                f" (intervals less than {MIN_NARROWING:.0%} narrower than the prior's;"
                " contraction_NAME in fits.parquet)."
            )
        sentences += self._noise()
        left = float(self.rows["noise_left"].median())
        if abs(left) > CORRELATED:
            sentences.append(
                f"What the noise's model leaves is still correlated ({left:.2f} from step to step):"
                " intervals may be too narrow; try calibration.noise_order=2 or longer steps"
                " (calibration.noise_step_s)."
            )
        return [table, *map(Text, sentences)]

    def _noise(self) -> list[str]:
        """Returns where noise enters, and whether forecasts with it hold what happened."""
        sentences = []
        if "noise" in self.rows:
            name = str(self.rows["noise"].iloc[0])
            sentence = f"Noise: {_NOISE[name]} (calibration.noise={name})"
            others = dict(self.evidence)
            evidence = others.pop(name, math.nan)
            if others:
                second = max(others, key=others.__getitem__)
                behind = evidence - others[second]
                sentence += (
                    f", the most evident kind; {second} comes next, {behind:.0f} nats behind"
                )
            sentences.append(f"{sentence}.")
        if "likelihood_power" in self.rows:
            power = float(self.rows["likelihood_power"].iloc[0])
            sentences.append(
                f"Each step counts {power:g} times (likelihood_power): the model's regimes jump,"
                " and intervals would be too narrow otherwise."
            )
        pairs = len(self.rows)
        if "held" in self.rows and not self.checked:
            sentences.append(
                "Nothing was held out (split=1), so that nothing checks these intervals."
            )
        if self.checked:
            contradicted = int(are_contradicted(self.rows).sum())
            sentence = (
                f"Forecasts from these posteriors hold {self.rows['held'].mean():.0%} of the"
                f" held-out parts ({INTERVAL_LEVEL:.0%} would be right)"
            )
            # Posteriors that are right are contradicted with the probability UNLIKELY each, which
            # is a binomial number of pairs: its mean and two standard deviations are no surprise.
            allowed = UNLIKELY * pairs + 2.0 * math.sqrt(UNLIKELY * (1.0 - UNLIKELY) * pairs)
            if contradicted > allowed:
                sentence += (
                    f"; of {contradicted} of {pairs} pairs less than chance allows (held_chance"
                    f" below {UNLIKELY:g} in fits.parquet): doubt the intervals, the model or its"
                    " noise is not theirs"
                )
            sentences.append(f"{sentence}.")
        return sentences

    def _doubts(self) -> list[str]:
        """Returns which pairs' intervals are not to be relied on, and which are rough."""
        sentences = []
        pairs = len(self.rows)
        doubtful = list(self.rows["pair_id"][~self.reliable])
        if doubtful:
            named = ", ".join(map(str, doubtful[:3])) + (" ..." if len(doubtful) > 3 else "")
            reason = f"samples of these posteriors do not settle (pareto_k above {MAX_PARETO_K}"
            if "divergences" in self.rows:
                reason = (
                    f"chains differ or leave out a part (r_hat above {MIXED} or divergences above"
                    f" {DIVERGENT}"
                )
            elif "r_hat" in self.rows:
                reason = f"chains differ (r_hat above {MIXED}"
            consequence = "too narrow"
            if "expected_coverage" in self.rows:
                consequence = "the network's alone"
            sentences.append(
                f"Do not rely on the intervals of {len(doubtful)} of {pairs} pairs ({named}):"
                f" {reason} in fits.parquet), and such intervals are {consequence}."
            )
        if "expected_coverage" in self.rows:
            coverage = float(self.rows["expected_coverage"].median())
            if abs(coverage - INTERVAL_LEVEL) > OFF:
                sentences.append(
                    f"Intervals of the network alone hold {coverage:.0%} of simulated drivers'"
                    f" parameters instead of {INTERVAL_LEVEL:.0%} (expected_coverage in"
                    " fits.parquet): it has learned too little."
                )
        few = int((self.reliable & (self.rows["effective_samples"] < ENOUGH)).sum())
        if few:
            sentences.append(
                f"The intervals of {few} of {pairs} pairs rest on fewer than {ENOUGH:.0f}"
                " independent samples (effective_samples in fits.parquet): their ends are rough."
            )
        return sentences


class Fits(ResultTable):
    """Errors of constant parameters, a row per pair and method; intervals of `driver_specific`."""

    meaning = (
        "errors of constant parameters on the part that was calibrated on, and on the test part;"
        " how well driver-specific ones are known"
    )
    order = 210
    always_printed = True
    columns = (
        PAIR,
        Column("driver", "", "the follower of the pair", "text", required=False),
        METHOD,
        Column("train_rmse_speed", "m/s", "on the part that was calibrated on"),
        Column("test_rmse_speed", "m/s", "on the test part", required=False),
        Column("train_rmse_gap", "m", "on the part that was calibrated on", required=False),
        Column("test_rmse_gap", "m", "on the test part", required=False),
        Column(
            "ends_apart",
            "1",
            "by which share of the loss independent ends of the search of `driver_specific` differ;"
            " above 0.01 the optimum may have been missed",
            required=False,
        ),
        Column(
            "median_NAME", "as of the parameter", "its median a posteriori, of `driver_specific`"
        ),
        Column("low_NAME", "as of the parameter", "the lower end of its 90 % interval"),
        Column("high_NAME", "as of the parameter", "the upper end"),
        Column(
            "contraction_NAME",
            "1",
            "by which share the interval is narrower than a priori; below 0.3 the recording does"
            " not determine the parameter",
        ),
        Column("noise", "", "where noise enters (`calibration.noise`)", "text", required=False),
        Column(
            "noise_gain",
            "1",
            "the driver's own share of it: 0, predicted in one closed loop, to 1, from each"
            " measured state to the next",
            required=False,
        ),
        Column(
            "likelihood_power",
            "1",
            "with which power the likelihood counts, where the model declares one below 1",
            required=False,
        ),
        Column("noise_scale", "m/s or m", "what each step of the noise adds", required=False),
        Column("noise_correlation", "1", "of the noise, one step later", required=False),
        Column("noise_left", "1", "the same of what its model leaves; 0: all", required=False),
        Column("held", "1", "share of the held-out steps that the 90 % fan holds", required=False),
        Column(
            "held_chance",
            "1",
            "how likely a fan that is right holds as little; below 0.05 the interval is in doubt",
            required=False,
        ),
        Column(
            "doubt",
            "",
            "why the interval is not to be taken at its word; empty where nothing is known",
            "text",
            required=False,
        ),
        Column("effective_samples", "1", "effective sample size of the intervals", required=False),
        Column(
            "pareto_k", "1", "above 0.7 these intervals are not to be relied on", required=False
        ),
        Column(
            "expected_coverage",
            "1",
            "share of simulated drivers' parameters that the network's 90 % intervals hold (`sbi`)",
            required=False,
        ),
        Column(
            "r_hat", "1", "of chains: above 1.05 the same (`nuts`, `hierarchical`)", required=False
        ),
        Column("divergences", "1", "share of draws: above 0.01 the same (`nuts`)", required=False),
    )

    def metrics(self, evaluation: Evaluation) -> dict[str, float]:
        parameters = KnownParameters.of(evaluation)
        return {} if parameters is None else parameters.metrics()

    def console(
        self, evaluation: Evaluation, metrics: Mapping[str, float]
    ) -> Iterable[RenderableType]:
        parameters = KnownParameters.of(evaluation)
        return [] if parameters is None else parameters.printed()


def history_metrics(history: pd.DataFrame) -> dict[str, float]:
    """Return `history/BASE/AMOUNT/improvement`, geometric over drivers.

    AMOUNT is `80pct` for "80 %" and `10s` for "10 s".
    """
    values = {}
    for (base, amount), rows in history.groupby(["base", "amount"]):
        name = str(amount).replace(" ", "").replace("%", "pct")
        ratios = 1.0 - rows["improvement"].to_numpy(float)
        improvement = improvement_statistics(np.ones_like(ratios), ratios, rows["driver"].tolist())
        values[f"history/{base}/{name}/improvement"] = improvement.geometric
    return values


class Sites(ResultTable):
    """Errors and improvements by site, where pairs of several sites were tested.

    The row `all` is the mean over sites: each counts once, however many pairs it has.
    """

    meaning = "a row per site and type of driver, where several sites were tested"
    suffix = ".csv"
    order = 30
    columns = (
        Column("scope", "", "`test` or `full_trajectory`", "text"),
        Column("site", "", "the road or area; `all`: the mean over sites", "text"),
        Column("driver_type", "", "what drives, `all` for all of them", "text"),
        Column("pairs", "1", "tested pairs", "int"),
        Column("drivers", "1", "their drivers", "int"),
        Column("rmse_speed_METHOD", "m/s", "RMSE of speed, mean over pairs"),
        Column("rmse_gap_METHOD", "m", "RMSE of the gap, mean over pairs"),
        Column(
            "METRIC_METHOD", "as of the metric", "the error that was minimised, mean over pairs"
        ),
        Column("over_BASELINE", "1", "the policy's improvement of that error, geometric"),
        Column("over_BASELINE_median", "1", "its median over pairs"),
        Column("over_BASELINE_low", "1", "lower end of the mean's 95 % interval over drivers"),
        Column("over_BASELINE_high", "1", "its upper end"),
    )

    def metrics(self, evaluation: Evaluation) -> Mapping[str, float]:
        columns = {}
        for method in METHODS:
            for metric in (evaluation.judge, "rmse_speed", "rmse_gap"):
                columns[f"{metric}_{method}"] = f"{metric}/{method}"
        for baseline in BASELINES:
            columns[f"over_{baseline}"] = f"improvement/{evaluation.judge}/{baseline}"
        metrics: dict[str, float] = {}
        table = evaluation.tables["sites"]
        for _, row in table[table["driver_type"] == ALL_SITES].iterrows():
            site = re.sub(r"[^\w.\- ]", "_", str(row["site"]))  # as MLflow takes names
            scope = "" if row["scope"] == "test" else "full_trajectory/"
            for column in row.index.intersection(list(columns)):
                metrics[f"{scope}site/{site}/{columns[column]}"] = float(row[column])
        return metrics

    def console(self, evaluation: Evaluation, metrics: Mapping[str, float]) -> Iterable[Table]:
        for scope, rows in evaluation.tables["sites"].groupby("scope", sort=False):
            yield _sites_printed(rows, scope_label(str(scope)), evaluation.judge_info)


def _sites_printed(rows: pd.DataFrame, scope: str, judge: MetricInfo) -> Table:
    """Returns the error by site and method, and the policy's improvement with its interval."""
    table = Table(title=f"By site, {scope}: {judge.title}; improvement, %", title_justify="left")
    table.add_column("site")
    table.add_column("drivers", justify="right")
    measured = set(rows.dropna(axis=1, how="all"))
    error_columns = []
    for method in METHODS:
        column = f"{judge.name}_{method}"
        if column in measured and method != "shrunk":
            table.add_column(short_label(method), justify="right")
            error_columns.append(column)
    improvement_columns = []
    for baseline in BASELINES:
        column = f"over_{baseline}"
        if column in measured:
            table.add_column(f"over {short_label(baseline)}", justify="right")
            improvement_columns.append(column)
    for _, row in rows.iterrows():
        name = escape(str(row["site"]))
        if row["driver_type"] != ALL_SITES:
            name = f"  {escape(str(row['driver_type']))}"
        cells = [f"{row[column]:.3f}" for column in error_columns]
        for column in improvement_columns:
            cell = f"{100 * row[column]:+.1f}"
            low, high = row[f"{column}_low"], row[f"{column}_high"]
            if math.isfinite(low):
                cell += f"\n{100 * low:+.1f} to {100 * high:+.1f}"
            cells.append(cell)
        table.add_row(name, f"{row['drivers']}", *cells)
    return table


class SiteStyles(ResultTable):
    """Driving style by site, where pairs are of several sites."""

    meaning = "driving style by site and type of driver, where there are several sites"
    suffix = ".csv"
    order = 51
    columns = (
        Column("site", "", "the road or area", "text"),
        Column("driver_type", "", "what drives, `all` for all of them", "text"),
        Column("drivers", "1", "its drivers", "int"),
        Column("score_median", "1", "median of their style scores"),
        Column("score_low", "1", "lower end of the median's 95 % interval over drivers"),
        Column("score_high", "1", "its upper end"),
        Column("score_q25", "1", "lower quartile of the scores"),
        Column("score_q75", "1", "upper quartile of the scores"),
        *_indicator_columns("median of an indicator"),
    )

    def rows(self, evaluation: Evaluation) -> Iterable[pd.DataFrame | None]:
        return [] if evaluation.style is None else [styles_by_site(evaluation.style)]


class StyleDistances(ResultTable):
    """How far apart the driving styles of sites are, and of types of drivers within a site."""

    meaning = "energy distances between the style scores of sites, and of types of drivers there"
    suffix = ".csv"
    order = 52
    columns = (
        Column("site", "", "the road or area", "text"),
        Column("driver_type", "", "what drives, `all` for all of them", "text"),
        Column("other_site", "", "what it is compared with", "text"),
        Column("other_driver_type", "", "likewise", "text"),
        Column("distance", "1", "energy distance of the scores"),
        Column("p_value", "1", "of a permutation of drivers, corrected for all comparisons"),
        Column("most", "", "the indicator that differs most", "text"),
        *(
            Column(f"distance_{name}", "1", "of a normalised indicator times its weight")
            for name in INDICATOR_NAMES
        ),
    )

    def rows(self, evaluation: Evaluation) -> Iterable[pd.DataFrame | None]:
        return [] if evaluation.style is None else [style_distances(evaluation.style)]


_UNLIKE = 3.0
"""Standard deviations from which on a driver is unlike those that were learned from."""

_FEW = 0.1
"""Share of such drivers that is not worth a word; of those learned from it is 0.01 to 0.04."""

_WORSE = 1.1
"""From this ratio of errors on, the policy is said to be worse than driver-specific parameters."""


class Past(ResultTable):
    """What each driver's past says of the policy and of driver-specific parameters.

    METHOD is `driver_specific`; `alone`, the policy alone; or `policy`, as it was tested: beside
    driver-specific parameters, if it combines.
    """

    meaning = "what each driver's past says of the policy (`protocol.combine`, `protocol=transfer`)"
    suffix = ".csv"
    order = 115
    always_printed = True
    columns = (
        PAIR,
        DRIVER,
        Column("share", "1", "the policy's share of the acceleration in the test part"),
        Column(
            "past_rmse_speed_METHOD",
            "m/s",
            "RMSE of speed over the last 40 % of the past, of which nothing was known; of `policy`"
            " that of the mean of both simulations",
        ),
        Column("rmse_speed_METHOD", "m/s", "RMSE of speed over the test part"),
        Column(
            "bound_METHOD",
            "m/s",
            f"what {EXPECTED_LEVEL:.0%} of drivers' RMSE of speed is expected below",
        ),
        Column(
            "unlike",
            "1",
            "how far the driver is from those that the policy learned from: the driver feature that"
            " is furthest from their mean, in standard deviations",
            required=False,
        ),
        Column("unlike_in", "", "which driver feature that is", "text", required=False),
    )

    def metrics(self, evaluation: Evaluation) -> Mapping[str, float]:
        table = evaluation.tables["past"]
        metrics = {
            "past/share": float(table["share"].mean()),
            "past/rmse_speed/alone": float(table["rmse_speed_alone"].mean()),
            "past/ratio/alone": _ratio(table["past_rmse_speed_alone"], table),
        }
        for method in ("policy", "driver_specific"):
            bound = table[f"bound_{method}"].dropna()
            if len(bound):
                below = table.loc[bound.index, f"rmse_speed_{method}"] <= bound
                metrics[f"past/bound/{method}"] = float(bound.mean())
                metrics[f"past/coverage/{method}"] = float(below.mean())
        if "unlike" in table and table["unlike"].notna().any():
            metrics["past/unlike"] = float((table["unlike"].dropna() > _UNLIKE).mean())
        return metrics

    def console(self, evaluation: Evaluation, metrics: Mapping[str, float]) -> Iterable[str]:
        """Returns how the two drove together, what error to expect, and a warning."""
        table = evaluation.tables["past"]
        if float(table["share"].min()) < 1:
            yield (
                "The policy drives beside driver-specific parameters, with a share of"
                f" {metrics['past/share']:.2f} on average, as their errors in the driver's past"
                f" give it; alone its RMSE of speed is {metrics['past/rmse_speed/alone']:.3f} m/s."
            )
        if "past/bound/policy" in metrics:
            yield (
                f"Expected of {EXPECTED_LEVEL:.0%} of drivers, from their past: RMSE of speed below"
                f" {metrics['past/bound/policy']:.3f} m/s (driver-specific parameters alone"
                f" {metrics['past/bound/driver_specific']:.3f} m/s); so it is for"
                f" {metrics['past/coverage/policy']:.0%} of them (bound_policy in past.csv)."
            )
        if metrics.get("past/unlike", 0.0) > _FEW:
            unlike = table[table["unlike"] > _UNLIKE]
            most = str(unlike["unlike_in"].mode()[0]).replace("_", " ")
            yield (
                f"[yellow]{len(unlike)} of {table['unlike'].notna().sum()} drivers drive unlike"
                f" those that it learned from, most often in their {most} (unlike in past.csv)."
            )
        ratio = _ratio(table["past_rmse_speed_alone"], table)
        if ratio > _WORSE:
            yield (
                f"[yellow]Expect {ratio:.1f} times the error of driver-specific parameters from"
                " this policy alone: it learned from no drivers like these. Train on recordings"
                " like this one."
            )


def _ratio(error: pd.Series, table: pd.DataFrame) -> float:
    """Returns the median ratio of an error in the past to that of driver-specific parameters."""
    baseline = table["past_rmse_speed_driver_specific"]
    ratio = (error / baseline.where(baseline > 0)).dropna()
    return float(ratio.median()) if len(ratio) else math.nan
