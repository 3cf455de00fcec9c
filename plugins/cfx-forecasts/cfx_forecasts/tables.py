"""The tables of forecasts."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from rich.table import Table

from cfx.plugin import Column, Evaluation, ResultTable
from cfx_forecasts.console import metrics_table
from cfx_forecasts.distributions import LEVEL, centre_errors, distribution_metrics, sampled_methods
from cfx_forecasts.errors import SCOPE, forecast_methods, forecast_metrics, metric_name

PAIR = Column("pair_id", "", "the pair of leader and follower", "text")
DRIVER = Column("driver", "", "the follower of the pair", "text")
METHOD = Column("method", "", "what chose the parameters", "text")


class ForecastErrors(ResultTable):
    """The error of every single forecast, a row per origin, method and horizon."""

    meaning = "the error of every single forecast (`protocol=forecast`)"
    order = 120
    always_printed = True
    columns = (
        PAIR,
        DRIVER,
        METHOD,
        Column("history_s", "s", "measured history up to the origin"),
        Column("horizon_s", "s", "time after the origin"),
        Column("speed_error", "m/s", "simulated minus measured, at the horizon"),
        Column("position_error", "m", "likewise"),
        Column("ade", "m", "absolute error of position, mean over the way to the horizon"),
    )

    def metrics(self, evaluation: Evaluation) -> dict[str, float]:
        return forecast_metrics(evaluation.tables["forecasts"])

    def console(self, evaluation: Evaluation, metrics: Mapping[str, float]) -> Iterable[Table]:
        """Returns the RMSE of speed of each method at each horizon: mean over drivers."""
        table = evaluation.tables["forecasts"]
        about = evaluation.notes["forecasts"]
        leader = "given"
        if about["leader"] != "given":
            leader = f"predicted at {about['leader'].replace('_', ' ')}"
        drivers = table["driver"].nunique()
        title = f"Forecasts of {drivers} drivers, leader {leader}: RMSE of speed (m/s) after"
        columns = {}
        for horizon in about["horizons_s"]:
            name = metric_name("rmse_speed", horizon)
            columns[f"{horizon:g} s"] = (f"{SCOPE}/{name}", ".3f")
        return [metrics_table(title, forecast_methods(table), columns, metrics)]


class Distributions(ResultTable):
    """Scores of sampled forecasts, a row per origin, method and horizon."""

    meaning = "scores of sampled forecasts, a row per origin (`protocol.samples`)"
    order = 130
    always_printed = True
    columns = (
        PAIR,
        DRIVER,
        METHOD,
        Column("horizon_s", "s", "time after the origin"),
        Column("crps_speed", "m/s", "CRPS of speed at the horizon"),
        Column("crps_gap", "m", "CRPS of the gap at the horizon"),
        Column("energy_speed", "m/s", "energy score of the path of speeds, per point"),
        Column("coverage", "1", "1 if the speed lies in the central 90 % of the sampled ones"),
        Column("min_ade", "m", "absolute error of position, the best of six paths"),
        Column("pit", "1", "share of sampled speeds below the one that happened"),
        Column("likelihood_speed", "1", "of the whole path up to the horizon"),
        Column("likelihood_gap", "1", "likewise"),
        Column("likelihood_acceleration", "1", "likewise"),
        Column("likelihood_jerk", "1", "likewise"),
        Column("likelihood_time_to_collision", "1", "likewise"),
    )

    def metrics(self, evaluation: Evaluation) -> dict[str, float]:
        return distribution_metrics(evaluation.tables["distributions"])

    def console(self, evaluation: Evaluation, metrics: Mapping[str, float]) -> Iterable[Table]:
        """Returns the CRPS of speed of each sampled method at each horizon, and its coverage.

        The policy's centre, a single path, has its absolute error instead, and no coverage.
        """
        tables = evaluation.tables
        horizons = evaluation.notes["forecasts"]["horizons_s"]
        methods = sampled_methods(tables["distributions"])
        crps, coverage = {}, {}
        for horizon in horizons:
            heading = f"{horizon:g} s"
            crps[heading] = (f"distribution/crps_speed_{horizon:g}s", ".3f")
            coverage[heading] = (f"distribution/coverage_{horizon:g}s", ".0%")
        title = "Sampled forecasts: CRPS of speed (m/s) after"
        table = metrics_table(title, methods, crps, metrics)
        centre = centre_errors(tables["forecasts"]).set_index("horizon_s")["crps_speed"]
        errors = [centre.get(horizon) for horizon in horizons]
        table.add_row("policy's centre", *("" if e is None else f"{e:.3f}" for e in errors))
        title = f"Sampled forecasts: coverage of the central {LEVEL:.0%} after"
        return [table, metrics_table(title, methods, coverage, metrics)]
