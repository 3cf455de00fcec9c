"""Figures show the numbers that were chosen: lines, limits, marks and intervals."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from cfx.evaluation.result import Evaluation
from cfx.figures.colours import colour_of
from cfx.learners.curves import over_networks
from cfx.results.figures.improvement_bars import draw_improvements, improvement_bars
from cfx.results.figures.learning_curve import draw_learning, loss_quartiles
from cfx.results.figures.pair_lines import (
    PairPanels,
    draw_pair,
    draw_pairs,
    draw_parameters,
    drives,
    pair_panels,
    rank_pairs,
)
from cfx.results.figures.parameter_spread import correlations, draw_calibration, parameter_spreads
from cfx.results.result import Result
from cfx_report.figures.jobs import draw_every_pair
from cfx_report.figures.platoon import braking_time, draw_platoons, worst_platoon
from cfx_report.runs import read_runs
from cfx_report.sections.figures import chosen_pairs
from tests.drawn import drawn_lines
from tests.job_folders import write_job
from tests.made_up import (
    make_platoon,
    make_results,
)


def make_panels(far: float = 0.0) -> tuple[Evaluation, PairPanels]:
    evaluation = make_results(pairs=1, frames=30).evaluation
    trajectory = evaluation.trajectories[0]
    gap = dict(trajectory.gap)
    gap["default"] = gap["default"] + np.linspace(0, far, 31)
    gap["policy"] = trajectory.real_gap - np.linspace(0, 40, 31)
    trajectory = dataclasses.replace(trajectory, gap=gap)
    axes = Result.of(evaluation).parameters
    return evaluation, pair_panels(trajectory, evaluation.methods, axes)


@pytest.mark.parametrize("far", [0.0, 500.0])
def test_a_pair_has_its_lines_limits_notes_and_collisions(far: float) -> None:
    evaluation, panels = make_panels(far)
    figure = draw_pairs([("", "", "")], [panels], evaluation.methods)
    for axes, panel in zip(figure.axes, (panels.speed, panels.gap), strict=True):
        assert list(axes.get_ylim()) == pytest.approx([panel.low, panel.high])
        lines = drawn_lines(axes)
        for line in panel.lines:
            np.testing.assert_allclose(lines[colour_of(line.method)].get_ydata(), line.values)
        written = "\n".join(text.get_text() for text in axes.texts)
        for note, _ in panel.notes:
            assert note in written
    assert [method for method, *_ in panels.gap.collisions] == ["policy"]
    assert "policy collides" in "\n".join(text.get_text() for text in figure.axes[1].texts)
    assert bool(panels.gap.notes) == (far > 0)


def test_parameters_have_their_limits_and_say_what_they_mean() -> None:
    evaluation = make_results(pairs=1, frames=30).evaluation
    meanings = ("reaction time; the equilibrium time gap", "")
    parameters = [
        dataclasses.replace(one, meaning=meaning)
        for one, meaning in zip(evaluation.parameters, meanings, strict=True)
    ]
    evaluation = dataclasses.replace(evaluation, parameters=tuple(parameters))
    axes = Result.of(evaluation).parameters
    panels = pair_panels(evaluation.trajectories[0], evaluation.methods, axes)
    alone = draw_parameters(panels, evaluation.methods).axes[1:]
    of_pair = draw_pair(Result.of(evaluation), panels.pair_id).axes[2:]
    for drawn in (alone, of_pair):
        for panel, one in zip(panels.parameters, drawn, strict=True):
            assert list(one.get_ylim()) == pytest.approx([panel.low, panel.high])
        assert [one.get_title(loc="left") for one in drawn] == list(meanings)


def test_a_hidden_method_is_left_out() -> None:
    methods = ("default", "driver_specific", "shrunk", "policy")
    evaluation = make_results(pairs=1, frames=30, methods=methods).evaluation
    panels = pair_panels(evaluation.trajectories[0], methods, Result.of(evaluation).parameters)
    figure = draw_pairs([("", "", "")], [panels], methods)
    assert colour_of("shrunk") not in drawn_lines(figure.axes[0])


def test_improvements_are_cut_off_at_one_place() -> None:
    values = np.array([0.3, 0.25, 0.2, 0.1, np.nan, -0.1, -0.2, -7.0, 0.15, 0.05])
    ids = [f"p{k}" for k in range(10)]
    summary = make_results(pairs=3).evaluation.improvements["test"]["driver_specific"]
    bars = improvement_bars(["job"], [ids], [values], marks=(summary.geometric,))
    (series,) = bars.series
    for figure in (draw_improvements(bars, summary), draw_every_pair(bars, series.pair_ids)):
        heights = [patch.get_height() for patch in figure.axes[0].patches if patch.get_width() < 1]
        np.testing.assert_allclose(heights[: len(series.shown)], series.shown)
        assert list(figure.axes[0].get_ylim()) == pytest.approx([bars.axis.low, bars.axis.high])
    assert bars.undefined == 1
    assert "1 of 9 improvements are lower" in bars.axis.note


def test_learning_curves_are_medians_and_quartiles() -> None:
    curves = make_results(pairs=9).curves
    axes = draw_learning(curves).axes[0]
    assert axes.get_yscale() == "log"
    shown = loss_quartiles(curves)
    assert list(shown) == ["train_loss", "validation_loss"]
    for k, (column, quartiles) in enumerate(shown.items()):
        median = over_networks(curves, column).median(axis=1)
        np.testing.assert_allclose(quartiles[0.5], median)
        np.testing.assert_allclose(axes.lines[k].get_ydata(), quartiles[0.5])
        outline = axes.collections[k].get_paths()[0].vertices
        assert outline[:, 1].min() == pytest.approx(quartiles[0.25].min())
        assert outline[:, 1].max() == pytest.approx(quartiles[0.75].max())
    half = curves["epoch"].median()
    sampled = curves.assign(sampled_paths=2 * (curves["epoch"] >= half))
    assert draw_learning(sampled).axes[0].lines[-1].get_xdata()[0] >= half


def test_platoons_show_speeds_collisions_and_verdicts() -> None:
    platoon = make_platoon({"default": 1, "policy": 3})
    stable = {"default": 1.0, "policy": 2 / 3}
    figure = draw_platoons(platoon.table, platoon.methods, stable)
    verdicts = ("string stable", "2 of 3 platoons are string stable")
    for axes, method, verdict in zip(figure.axes, platoon.methods, verdicts, strict=True):
        rows, _ = worst_platoon(platoon.table[platoon.table["method"] == method])
        lines = [line for line in axes.lines if len(line.get_xdata()) > 1]
        for (_, of_vehicle), line in zip(rows.groupby("vehicle"), lines, strict=True):
            speeds = of_vehicle.set_index("time_s")["speed"]
            shown = speeds.loc[line.get_xdata() + braking_time(rows)]
            np.testing.assert_allclose(line.get_ydata(), shown)
        hits = rows[rows["gap"] < 0]["vehicle"].nunique()
        assert len(axes.lines) - len(lines) == hits
        title = axes.get_title(loc="left")
        assert verdict in title
        assert "last follower: " in title
    hits = any(len(line.get_xdata()) == 1 for axes in figure.axes for line in axes.lines)
    named = [text.get_text() for text in figure.legends[0].get_texts()]
    assert named[:3] == ["leader", "first follower", "last follower"]
    assert ("collision" in named) == hits
    low, high = figure.axes[0].get_ylim()
    speeds = np.concatenate([line.get_ydata() for axes in figure.axes for line in axes.lines])
    assert low < speeds.min() < speeds.max() < high


def test_the_report_of_a_job_shows_the_pairs_of_its_figures(tmp_path: Path) -> None:
    """The one reads files, the other an evaluation: both rank the same pairs."""
    write_job(tmp_path / "job", pairs=8)
    (job,) = read_runs([str(tmp_path)]).jobs
    evaluation = make_results(pairs=8, frames=40, epochs=12).evaluation
    rows = evaluation.table[evaluation.table["method"] == "policy"]
    gains = rows["improvement_over_driver_specific"].to_numpy(dtype=float)
    ranked = rank_pairs(rows["pair_id"].tolist(), gains)
    assert [one.pair_id for one in chosen_pairs(job)] == [one.pair_id for one in ranked]
    for results in (Result.of(evaluation), job):
        figure = drives(results)
        titles = "\n".join(text.get_text() for axes in figure.axes for text in axes.texts)
        for one in ranked:
            assert f"{one.rank} pair, {one.pair_id}" in titles


def test_calibrated_parameters_have_their_places_and_correlations() -> None:
    evaluation = make_results(
        pairs=9, frames=20, methods=("default", "pooled", "driver_specific")
    ).evaluation
    spreads = parameter_spreads(evaluation.table, Result.of(evaluation).parameters)
    table = correlations(evaluation.table, Result.of(evaluation).parameters)
    drawn, image = draw_calibration(spreads, table).axes[:2]
    places = []
    for line in drawn.lines:
        if line.get_color() == colour_of("driver_specific"):
            places.append(np.asarray(line.get_xdata(), dtype=float))
    for found, spread in zip(places, spreads, strict=True):
        np.testing.assert_allclose(found, spread.places(spread.values))
    np.testing.assert_allclose(np.asarray(image.images[0].get_array()), table.to_numpy())
