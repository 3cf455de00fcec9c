"""The table of how well parameters fit, and how well they are known."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from rich.console import RenderableType

from cfx.evaluation.result import Evaluation
from cfx.results.table import Column, ResultTable
from cfx.results.tables.columns import METHOD, PAIR
from cfx.results.tables.known_parameters import KnownParameters


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
