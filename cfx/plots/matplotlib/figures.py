"""Figures of an evaluation: what `choice` chose of it, drawn."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from cfx.errors import ConfigError, nearest
from cfx.evaluation.forecasts import Forecasts, errors_by_history
from cfx.evaluation.result import Evaluation, PairTrajectory, Platoon
from cfx.evaluation.traffic.result import Traffic
from cfx.plots.choice.calibration import correlations, parameter_spreads
from cfx.plots.choice.distributions import distribution_view
from cfx.plots.choice.errors import error_panels
from cfx.plots.choice.forecasts import (
    HISTORY_TITLE,
    HORIZON_TITLE,
    history_panels,
    horizon_panels,
)
from cfx.plots.choice.history import amounts_of, history_curves
from cfx.plots.choice.improvements import improvement_bars, improvement_title
from cfx.plots.choice.learning import learning_curves
from cfx.plots.choice.pairs import RankedPair, rank_pairs
from cfx.plots.choice.platoon import platoon_panels
from cfx.plots.choice.style import style_histogram
from cfx.plots.choice.traffic import path_panels, traffic_panels
from cfx.plots.choice.trajectories import (
    HIDDEN,
    PairPanels,
    errors_text,
    method_panels,
    pair_panels,
    parameter_axes,
)
from cfx.plots.matplotlib.calibration import draw_calibration
from cfx.plots.matplotlib.distributions import draw_distributions
from cfx.plots.matplotlib.errors import draw_errors
from cfx.plots.matplotlib.forecasts import draw_forecasts
from cfx.plots.matplotlib.history import draw_history
from cfx.plots.matplotlib.improvements import draw_improvements
from cfx.plots.matplotlib.learning import draw_learning
from cfx.plots.matplotlib.platoon import draw_platoons
from cfx.plots.matplotlib.style import draw_style
from cfx.plots.matplotlib.traffic import draw_paths, draw_traffic
from cfx.plots.matplotlib.trajectories import draw_pairs, draw_parameters, draw_speeds
from cfx.plots.words import percent, short
from cfx.simulation.trajectory import TRANSIENT_S
from cfx.style.result import StyleResult


def improvements(evaluation: Evaluation) -> Figure:
    """Improvement of every pair over driver-specific calibration."""
    rows = evaluation.table[evaluation.table["method"] == "policy"]
    summary = evaluation.improvement
    bars = improvement_bars(
        [""],
        [rows["pair_id"].astype(str).tolist()],
        [rows["improvement"].to_numpy(dtype=float)],
        marks=(summary.mean, summary.ci95_low, summary.ci95_high),
    )
    return draw_improvements(bars, summary)


def pairs(
    evaluation: Evaluation, pair_id: str | Sequence[str] | None = None, count: int = 3
) -> Figure:
    """Speed and gap over the test part, a row per pair.

    Args:
        evaluation: of a job.
        pair_id: the pairs to show; None for `count` pairs from the best to the worst improvement,
            without a policy from the smallest to the largest error.
        count: how many.

    Raises:
        ConfigError: a pair id is not in the evaluation.
    """
    titles, panels = [], []
    explained: str | None = None
    for ranked, trajectory in _chosen(evaluation, pair_id, count):
        name = RankedPair(short(ranked.pair_id), ranked.rank, ranked.improvement).title
        if np.isfinite(ranked.improvement):
            name += f":  {percent(ranked.improvement)}"
            explained = f"percentages: {improvement_title('fixed')}"
        elif {"fixed", "policy"} <= set(evaluation.methods):
            name += ":  improvement undefined"
        rmse = errors_text("speed", "m/s", _errors(evaluation, trajectory.pair_id, "rmse_speed"))
        rmse_gap = errors_text("gap", "m", _errors(evaluation, trajectory.pair_id, "rmse_gap"))
        titles.append((name, rmse, rmse_gap))
        panels.append(_panels(evaluation, trajectory))
    return draw_pairs(titles, panels, evaluation.methods, explained)


def speeds(evaluation: Evaluation, pair_id: str | None = None) -> Figure:
    """The simulated speed of each method against the real driver's: the paper's speed plots.

    Args:
        evaluation: of a job.
        pair_id: the pair to show; None for the one with the median improvement.

    Raises:
        ConfigError: the pair id is not in the evaluation.
    """
    ((_, trajectory),) = _chosen(evaluation, pair_id, 1)
    errors = _errors(evaluation, trajectory.pair_id, "rmse_speed")
    panels = method_panels(trajectory, evaluation.methods, errors)
    return draw_speeds(trajectory.pair_id, panels, evaluation.methods)


def parameters(evaluation: Evaluation, pair_id: str | None = None) -> Figure:
    """The parameters of each method over time.

    Args:
        evaluation: of a job.
        pair_id: the pair to show; None for the one with the median improvement.

    Raises:
        ConfigError: the pair id is not in the evaluation.
    """
    ((_, trajectory),) = _chosen(evaluation, pair_id, 1)
    return draw_parameters(_panels(evaluation, trajectory), evaluation.methods)


def errors(evaluation: Evaluation) -> Figure:
    """RMSE of speed and of gap over all pairs at each moment since the test part began."""
    methods = [method for method in evaluation.methods if method not in HIDDEN]
    return draw_errors(error_panels(evaluation.trajectories, methods, TRANSIENT_S), methods)


def calibration(evaluation: Evaluation) -> Figure:
    """The calibrated parameters of all drivers between their bounds, and their correlations.

    Raises:
        ConfigError: no calibrated parameter of a driver is known.
    """
    axes = parameter_axes(evaluation)
    spreads = parameter_spreads(evaluation.table, axes)
    if not spreads:
        raise ConfigError("the evaluation holds no driver-specific parameters")
    table = correlations(evaluation.table, [spread.axis for spread in spreads])
    return draw_calibration(spreads, table)


def style(result: StyleResult) -> Figure:
    """Style scores with the cuts, and the entropy weights."""
    scores = result.table["score"].to_numpy(dtype=float)
    clusters = result.table["cluster"].to_numpy(dtype=int)
    return draw_style(style_histogram(scores, clusters, result.cuts), result.weights)


def learning(curves: pd.DataFrame) -> Figure:
    """Loss by epoch; `curves` as `choice.learning.learning_curves` takes them."""
    return draw_learning(learning_curves(curves))


def platoons(platoon: Platoon) -> Figure:
    """Speeds of the platoons behind a braking leader, a panel per method."""
    shares = platoon.measures.groupby("method")["string_stable"].mean()
    stable = {method: float(shares[method]) for method in platoon.methods}
    return draw_platoons(platoon_panels(platoon.table, platoon.methods, stable))


def history(table: pd.DataFrame) -> Figure:
    """Improvement by the amount of burn-in; `table` as `Evaluation.history`."""
    return draw_history(history_curves(table), amounts_of(table))


def forecasts(result: Forecasts) -> Figure:
    """Errors of speed and position against the horizon."""
    panels = horizon_panels(result.summary, result.methods)
    return draw_forecasts(panels, result.methods, HORIZON_TITLE)


def forecasts_by_history(result: Forecasts) -> Figure:
    """Errors of speed against how much of a driver had been measured.

    Raises:
        ConfigError: all origins have about the same history.
    """
    panels = history_panels(errors_by_history(result.table), result.methods)
    if not panels:
        raise ConfigError(
            "all origins have about the same history: lower protocol.min_history, or use longer"
            " trajectories"
        )
    return draw_forecasts(panels, result.methods, HISTORY_TITLE)


def distributions(result: Forecasts) -> Figure:
    """CRPS and coverage of sampled forecasts against the horizon, and their PIT.

    Raises:
        ConfigError: none were sampled.
    """
    if result.distributions is None:
        raise ConfigError("no forecasts were sampled: set protocol.samples=50")
    return draw_distributions(distribution_view(result.distributions, result.table))


def traffic(result: Traffic) -> Figure:
    """Flow, variation and waves against density, growth along platoons; beside the recording."""
    panels = traffic_panels(
        result.roads, result.growth, result.strips, result.real_wave_speed, result.methods
    )
    return draw_traffic(panels, result.methods)


def traffic_paths(result: Traffic) -> Figure:
    """The vehicles of one ring over time, a panel per method."""
    return draw_paths(path_panels(result.paths, result.methods))


def _chosen(
    evaluation: Evaluation, pair_id: str | Sequence[str] | None, count: int
) -> list[tuple[RankedPair, PairTrajectory]]:
    by_id = {trajectory.pair_id: trajectory for trajectory in evaluation.trajectories}
    is_calibration = "policy" not in evaluation.methods
    judged = _constant(evaluation) if is_calibration else "policy"
    rows = evaluation.table[evaluation.table["method"] == judged]
    rows = rows[rows["pair_id"].isin(list(by_id))]
    gains = pd.Series(np.nan, index=rows["pair_id"].astype(str))
    # Without driver-specific calibration there is nothing to be better than.
    if "improvement" in rows and not is_calibration:
        gains[:] = rows["improvement"].to_numpy(dtype=float)
    if pair_id is None:
        values = gains.to_numpy(dtype=float)
        if is_calibration:
            values = -rows["rmse_speed"].to_numpy(dtype=float)
        ranked = rank_pairs(list(gains.index), values, count)
        if is_calibration:
            ranked = tuple(RankedPair(pair.pair_id, pair.rank, math.nan) for pair in ranked)
        return [(pair, by_id[pair.pair_id]) for pair in ranked]
    wanted = [pair_id] if isinstance(pair_id, str) else list(pair_id)
    chosen = []
    for name in wanted:
        if name not in by_id:
            hint = nearest(name, by_id)
            raise ConfigError(f"pair '{name}' is not in this evaluation.{hint}")
        chosen.append((RankedPair(name, "", float(gains[name])), by_id[name]))
    return chosen


def _constant(evaluation: Evaluation) -> str:
    """Returns the calibrated constant set that is shown: the drivers' own, if there are any."""
    shown = [method for method in evaluation.methods if method not in HIDDEN]
    return shown[-1]


def _errors(evaluation: Evaluation, pair_id: str, column: str) -> dict[str, float]:
    """Returns the errors of one pair by method, in the methods' order."""
    rows = evaluation.table[evaluation.table["pair_id"] == pair_id].drop_duplicates("method")
    errors = rows.set_index("method")[column]
    return {method: float(errors[method]) for method in evaluation.methods if method in errors}


def _panels(evaluation: Evaluation, trajectory: PairTrajectory) -> PairPanels:
    axes = parameter_axes(evaluation)
    return pair_panels(trajectory, evaluation.methods, axes)
