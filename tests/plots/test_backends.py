"""Both back ends show what was chosen, and so the same."""

from __future__ import annotations

import base64
import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cfx.evaluation.forecasts import errors_by_history
from cfx.evaluation.result import Evaluation
from cfx.plots.choice.calibration import correlations, parameter_spreads
from cfx.plots.choice.distributions import distribution_view
from cfx.plots.choice.errors import error_panels
from cfx.plots.choice.forecasts import history_panels, horizon_panels
from cfx.plots.choice.history import amounts_of, history_curves
from cfx.plots.choice.improvements import improvement_bars
from cfx.plots.choice.learning import learning_curves
from cfx.plots.choice.pairs import rank_pairs
from cfx.plots.choice.platoon import platoon_panels, speed_range
from cfx.plots.choice.style import style_histogram
from cfx.plots.choice.traffic import path_panels, traffic_panels
from cfx.plots.choice.trajectories import PairPanels, pair_panels, parameter_axes
from cfx.plots.look import colour_of
from cfx.plots.matplotlib import figures
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
from cfx.plots.matplotlib.trajectories import draw_pairs, draw_parameters
from cfx.plots.plotly.calibration import calibration_plot
from cfx.plots.plotly.distributions import distributions_plot
from cfx.plots.plotly.errors import errors_plot
from cfx.plots.plotly.forecasts import forecasts_plot
from cfx.plots.plotly.history import history_plot
from cfx.plots.plotly.improvements import improvements_view
from cfx.plots.plotly.learning import learning_plot
from cfx.plots.plotly.platoon import platoon_plot
from cfx.plots.plotly.style import style_plot
from cfx.plots.plotly.traffic import traffic_plot
from cfx.plots.plotly.trajectories import pair_plot
from cfx.plots.words import label
from cfx.report.runs import read_runs
from cfx.report.sections.trajectories import chosen_pairs
from tests.made_up import (
    GAINS,
    make_distributions,
    make_forecasts,
    make_history,
    make_platoon,
    make_results,
    make_traffic,
)
from tests.report.folders import write_job

Trace = dict[str, Any]


def view_of(plot: Any) -> Any:
    return plot.views[""]


def numbers(values: Any) -> Any:
    """Returns what a trace holds; plotly packs arrays."""
    if isinstance(values, dict):
        return np.frombuffer(base64.b64decode(values["bdata"]), dtype=values["dtype"])
    return np.asarray(values)


def on_axes(view: Any, number: str) -> list[Trace]:
    """Returns the lines that stand on one pair of axes."""
    found = []
    for trace in view["data"]:
        if trace.get("yaxis", "y") == f"y{number}" and "lines" in trace["mode"]:
            found.append(trace)
    return found


def drawn_lines(axes: Axes) -> dict[str, Any]:
    """Returns matplotlib's lines by colour, those of references and marks left out."""
    found = {}
    for line in axes.lines:
        if len(line.get_xdata()) > 2:
            found[line.get_color()] = line
    return found


def make_panels(far: float = 0.0) -> tuple[Evaluation, PairPanels]:
    evaluation = make_results(pairs=1, frames=30).evaluation
    trajectory = evaluation.trajectories[0]
    gap = dict(trajectory.gap)
    gap["default"] = gap["default"] + np.linspace(0, far, 31)
    gap["policy"] = trajectory.real_gap - np.linspace(0, 40, 31)
    trajectory = dataclasses.replace(trajectory, gap=gap)
    axes = parameter_axes(evaluation)
    return evaluation, pair_panels(trajectory, evaluation.methods, axes)


@pytest.mark.parametrize("far", [0.0, 500.0])
def test_a_pair_has_the_same_lines_limits_notes_and_collisions(far: float) -> None:
    evaluation, panels = make_panels(far)
    figure = draw_pairs([("", "", "")], [panels], evaluation.methods)
    view = view_of(pair_plot(panels))
    for axes, panel, number in zip(figure.axes, (panels.speed, panels.gap), ("", "2"), strict=True):
        assert list(axes.get_ylim()) == pytest.approx([panel.low, panel.high])
        assert view["layout"][f"yaxis{number}"]["range"] == pytest.approx([panel.low, panel.high])
        lines, traces = drawn_lines(axes), on_axes(view, number)
        assert len(traces) == len(panel.lines)
        for line, trace in zip(panel.lines, traces, strict=True):
            drawn = lines[colour_of(line.method)]
            np.testing.assert_allclose(drawn.get_ydata(), line.values)
            np.testing.assert_allclose(numbers(trace["y"]), line.values, rtol=1e-5)
            assert trace["line"]["color"] == drawn.get_color()
        written = "\n".join(text.get_text() for text in axes.texts)
        notes = [note["text"] for note in view["layout"]["annotations"]]
        for note in panel.notes:
            assert note.text in written
            assert note.text in notes
    assert [one.method for one in panels.gap.collisions] == ["policy"]
    assert "policy collides" in "\n".join(text.get_text() for text in figure.axes[1].texts)
    assert "policy collides" in [trace["name"] for trace in view["data"]]
    assert bool(panels.gap.notes) == (far > 0)


def test_parameters_have_the_same_limits() -> None:
    evaluation, panels = make_panels()
    figure = draw_parameters(panels, evaluation.methods)
    layout = view_of(pair_plot(panels))["layout"]
    for k, panel in enumerate(panels.parameters):
        ends = [panel.low, panel.high]
        assert list(figure.axes[k + 1].get_ylim()) == pytest.approx(ends)
        assert layout[f"yaxis{k + 3}"]["range"] == pytest.approx(ends)


def test_parameters_say_what_they_mean() -> None:
    evaluation = make_results(pairs=1, frames=30).evaluation
    meanings = ("reaction time; the equilibrium time gap", "")
    evaluation = dataclasses.replace(evaluation, meanings=meanings)
    axes = parameter_axes(evaluation)
    panels = pair_panels(evaluation.trajectories[0], evaluation.methods, axes)
    figure = draw_parameters(panels, evaluation.methods)
    assert [one.get_title(loc="left") for one in figure.axes[1:]] == list(meanings)
    headings = view_of(pair_plot(panels))["layout"]["annotations"]
    assert meanings[0] in [one.get("hovertext") for one in headings]


def test_a_hidden_method_is_left_out_or_waits_in_the_legend() -> None:
    methods = ("default", "fixed", "shrunk", "policy")
    evaluation = make_results(pairs=1, frames=30, methods=methods).evaluation
    axes = parameter_axes(evaluation)
    panels = pair_panels(evaluation.trajectories[0], methods, axes)
    figure = draw_pairs([("", "", "")], [panels], methods)
    assert colour_of("shrunk") not in drawn_lines(figure.axes[0])
    waiting = {
        trace["legendgroup"]
        for trace in view_of(pair_plot(panels))["data"]
        if trace.get("visible") == "legendonly"
    }
    assert waiting == {"shrunk"}


def test_the_same_pairs_are_cut_off_at_the_same_place() -> None:
    values = np.array([0.3, 0.25, 0.2, 0.1, np.nan, -0.1, -0.2, -7.0, 0.15, 0.05])
    ids = [f"p{k}" for k in range(10)]
    summary = make_results(pairs=3).evaluation.improvement
    bars = improvement_bars(["job"], [ids], [values], marks=(summary.mean,))
    (series,) = bars.series
    figure = draw_improvements(bars, summary)
    view = improvements_view(bars, ids, [dict.fromkeys(ids, "")])
    heights = [patch.get_height() for patch in figure.axes[0].patches if patch.get_width() < 1]
    np.testing.assert_allclose(heights[: len(series.shown)], series.shown)
    np.testing.assert_allclose(numbers(view["data"][0]["y"]), series.shown)
    assert list(view["data"][0]["x"]) == list(series.pair_ids)
    assert list(view["data"][1]["x"]) == ["p7"]
    assert list(figure.axes[0].get_ylim()) == pytest.approx([bars.axis.low, bars.axis.high])
    assert view["layout"]["yaxis"]["range"] == pytest.approx([bars.axis.low, bars.axis.high])
    assert bars.undefined == 1
    assert "1 of 9 improvements are lower" in view["note"]
    assert "1 without a defined improvement" in figure.axes[0].get_xlabel()


def test_both_say_from_where_on_sampled_paths_count() -> None:
    curves = make_results(pairs=9).curves
    half = curves["epoch"].median()
    chosen = learning_curves(curves.assign(sampled_paths=2 * (curves["epoch"] >= half)))
    line = draw_learning(chosen).axes[0].lines[-1]
    shape = view_of(learning_plot(chosen))["layout"]["shapes"][0]
    assert line.get_label() == shape["label"]["text"]
    assert line.get_xdata()[0] == shape["x0"] == shape["x1"] >= half
    assert "shapes" not in view_of(learning_plot(learning_curves(curves)))["layout"]


def test_learning_curves_are_medians_and_quartiles_in_both() -> None:
    chosen = learning_curves(make_results(pairs=9).curves)
    axes = draw_learning(chosen).axes[0]
    view = view_of(learning_plot(chosen))
    assert chosen.logarithmic
    assert axes.get_yscale() == view["layout"]["yaxis"]["type"] == "log"
    assert list(view["layout"]["yaxis"]["tickvals"]) == pytest.approx(list(axes.get_yticks()))
    medians = [trace for trace in view["data"] if trace.get("showlegend", True)]
    bands = [trace for trace in view["data"] if not trace.get("showlegend", True)]
    for k, curve in enumerate(chosen.curves):
        np.testing.assert_allclose(axes.lines[k].get_ydata(), curve.median)
        np.testing.assert_allclose(numbers(medians[k]["y"]), curve.median)
        np.testing.assert_allclose(numbers(bands[2 * k]["y"]), curve.low)
        np.testing.assert_allclose(numbers(bands[2 * k + 1]["y"]), curve.high)
        outline = axes.collections[k].get_paths()[0].vertices
        assert outline[:, 1].min() == pytest.approx(curve.low.min())
        assert outline[:, 1].max() == pytest.approx(curve.high.max())
    assert "median and quartiles" in view["layout"]["legend"]["title"]["text"]
    assert "median and quartiles" in chosen.title


def test_platoons_show_the_same_network_speeds_and_verdicts() -> None:
    platoon = make_platoon({"default": 1, "policy": 3})
    panels = platoon_panels(platoon.table, platoon.methods, {"default": 1.0, "policy": 2 / 3})
    figure = draw_platoons(panels)
    view = view_of(platoon_plot(panels))
    headings = [note["text"] for note in view["layout"]["annotations"]]
    for k, panel in enumerate(panels):
        number = str(k + 1) if k else ""
        axes, traces = figure.axes[k], on_axes(view, number)
        lines = [line for line in axes.lines if len(line.get_xdata()) > 1]
        # The leader is drawn last in one, and above the others in the other.
        for line, trace in zip(panel.lines, [traces[-1], *traces[:-1]], strict=True):
            np.testing.assert_allclose(lines[line.vehicle].get_ydata(), line.speed)
            np.testing.assert_allclose(numbers(trace["y"]), line.speed, atol=0.006)
            assert trace["line"]["color"] == lines[line.vehicle].get_color()
        hits = sum(line.collision is not None for line in panel.lines)
        marks = [t for t in view["data"] if t["mode"] == "markers" and t["yaxis"] == f"y{number}"]
        assert len(marks) == len(axes.lines) - len(lines) == hits
        for verdict in panel.verdicts:
            assert verdict in axes.get_title(loc="left")
            assert verdict in headings[k]
    assert figure.axes[0].get_ylim() == pytest.approx(speed_range(panels))
    assert tuple(view["layout"]["yaxis"]["range"]) == pytest.approx(speed_range(panels))


def test_history_has_the_same_means_and_intervals() -> None:
    history = make_history(make_results(pairs=6, frames=20).evaluation.trajectories, GAINS)
    curves, amounts = history_curves(history), amounts_of(history)
    axes = draw_history(curves, amounts).axes[0]
    view = view_of(history_plot(curves, amounts))
    for curve, container, trace in zip(curves, axes.containers, view["data"], strict=True):
        np.testing.assert_allclose(container.lines[0].get_ydata(), curve.mean)
        np.testing.assert_allclose(numbers(trace["y"]), curve.mean)
        segments = np.array(container.lines[2][0].get_segments())
        low = numbers(trace["y"]) - numbers(trace["error_y"]["arrayminus"])
        np.testing.assert_allclose(segments[:, 0, 1], low)
        assert container.get_label() == trace["name"]
    assert list(view["layout"]["xaxis"]["categoryarray"]) == amounts


def test_forecasts_have_the_same_lines() -> None:
    forecasts = make_forecasts()
    panels = horizon_panels(forecasts.summary, forecasts.methods)
    panels += history_panels(errors_by_history(forecasts.table), forecasts.methods)
    assert len(panels) == 5
    figure = draw_forecasts(panels, forecasts.methods, "any")
    view = view_of(forecasts_plot(panels, "any"))
    for k, panel in enumerate(panels):
        lines = drawn_lines(figure.axes[k])
        traces = on_axes(view, str(k + 1) if k else "")
        assert len(panel.lines) == len(lines) == len(traces) == len(forecasts.methods)
        for line, trace in zip(panel.lines, traces, strict=True):
            drawn = lines[colour_of(line.method)]
            np.testing.assert_allclose(drawn.get_ydata(), line.values)
            np.testing.assert_allclose(numbers(trace["y"]), line.values, rtol=1e-6)
            np.testing.assert_allclose(numbers(trace["x"]), drawn.get_xdata())
        is_logarithmic = figure.axes[k].get_yscale() == "log"
        assert is_logarithmic == panel.logarithmic
        assert (view["layout"][f"yaxis{k + 1 if k else ''}"].get("type") == "log") == is_logarithmic


def test_distributions_have_the_same_lines_and_histograms() -> None:
    forecasts = make_forecasts()
    shown = distribution_view(make_distributions(forecasts), forecasts.table)
    assert shown.methods == ("population_ar", "fixed_ar", "policy_sampled", "policy")
    assert shown.horizon == 2.0
    figure = draw_distributions(shown)
    view = view_of(distributions_plot(shown))
    for k, panel in enumerate((shown.crps, shown.coverage)):
        lines = drawn_lines(figure.axes[k])
        traces = on_axes(view, str(k + 1) if k else "")
        assert len(traces) == len(panel.lines)
        for line, trace in zip(panel.lines, traces, strict=True):
            np.testing.assert_allclose(lines[colour_of(line.method)].get_ydata(), line.values)
            np.testing.assert_allclose(numbers(trace["y"]), line.values, rtol=1e-6)
    traces = on_axes(view, "3")
    patches = figure.axes[2].patches
    for histogram, patch, trace in zip(shown.pit, patches, traces, strict=True):
        assert histogram.density.mean() == pytest.approx(1.0)
        np.testing.assert_allclose(patch.get_data().values, histogram.density)
        np.testing.assert_allclose(numbers(trace["y"])[:-1], histogram.density, rtol=1e-6)


def test_traffic_has_the_same_lines_and_points() -> None:
    traffic = make_traffic()
    tables = (traffic.roads, traffic.growth, traffic.strips, traffic.real_wave_speed)
    panels = traffic_panels(*tables, traffic.methods)
    figure = draw_traffic(panels, traffic.methods)
    view = view_of(traffic_plot(panels))
    assert len(panels) == 4
    for k, panel in enumerate(panels):
        number = str(k + 1) if k else ""
        lines = drawn_lines(figure.axes[k])
        traces = on_axes(view, number)
        assert len(panel.lines) == len(traces)
        for line, trace in zip(panel.lines, traces, strict=True):
            np.testing.assert_allclose(numbers(trace["y"]), line.values, rtol=1e-6)
            if len(line.time) > 2:
                drawn = lines[colour_of(line.method)]
                np.testing.assert_allclose(drawn.get_ydata(), line.values)
    (cloud,) = (trace for trace in view["data"] if trace["mode"] == "markers")
    points = figure.axes[0].collections[0].get_offsets()
    np.testing.assert_allclose(numbers(cloud["x"]), np.asarray(points)[:, 0], atol=0.06)
    without = traffic_panels(traffic.roads, traffic.growth.iloc[:0], *tables[2:], traffic.methods)
    assert len(without) == 3
    paths = draw_paths(path_panels(traffic.paths, traffic.methods))
    assert [axes.get_title(loc="left") for axes in paths.axes[:3]] == [
        label(method) for method in traffic.methods
    ]


def test_longer_histories_stand_to_the_right() -> None:
    forecasts = make_forecasts()
    (short, *_, long) = history_panels(errors_by_history(forecasts.table), ["policy"])
    assert long.title.startswith("RMSE of speed after 10 s")
    (line,) = short.lines
    assert bool((np.diff(line.time) > 0).all())
    assert bool((np.diff(line.values) < 0).all())


def test_style_has_the_same_bars_and_cuts() -> None:
    style = make_results(pairs=40, frames=5).style
    scores = style.table["score"].to_numpy(dtype=float)
    histogram = style_histogram(scores, style.table["cluster"].to_numpy(), style.cuts)
    axes = draw_style(histogram, style.weights).axes[0]
    view = view_of(style_plot(histogram))
    for cluster, container, trace in zip(
        histogram.clusters, axes.containers, view["data"], strict=True
    ):
        assert [bar.get_height() for bar in container] == list(cluster.counts)
        assert list(numbers(trace["y"])) == list(cluster.counts)
        assert container.get_label() == trace["name"]
    assert view["layout"]["shapes"][0]["x0"] == pytest.approx(histogram.cuts[0])
    assert axes.get_ylim()[1] == pytest.approx(view["layout"]["yaxis"]["range"][1])


def test_errors_over_time_are_the_same() -> None:
    evaluation = make_results(pairs=5, frames=80).evaluation
    panels = error_panels(evaluation.trajectories, evaluation.methods, 5.0)
    figure: Figure = draw_errors(panels, evaluation.methods)
    view = view_of(errors_plot(panels))
    for k, panel in enumerate(panels):
        lines, traces = drawn_lines(figure.axes[k]), on_axes(view, str(k + 1) if k else "")
        for line, trace in zip(panel.lines, traces, strict=True):
            np.testing.assert_allclose(lines[colour_of(line.method)].get_ydata(), line.values)
            np.testing.assert_allclose(numbers(trace["y"]), line.values, rtol=1e-5)
        assert panel.shows_transient
    assert [shape["x0"] for shape in view["layout"]["shapes"]] == [5.0, 5.0]


def test_the_report_of_a_job_shows_the_pairs_of_its_figures(tmp_path: Path) -> None:
    """The one reads files, the other an evaluation: both rank the same pairs."""
    write_job(tmp_path / "job", pairs=8)
    (job,) = read_runs([str(tmp_path)]).jobs
    evaluation = make_results(pairs=8, frames=40, epochs=12).evaluation
    rows = evaluation.table[evaluation.table["method"] == "policy"]
    gains = rows["improvement"].to_numpy(dtype=float)
    ranked = rank_pairs(rows["pair_id"].tolist(), gains)
    assert [one.pair_id for one in chosen_pairs(job)] == [one.pair_id for one in ranked]
    figure = figures.pairs(evaluation)
    titles = "\n".join(text.get_text() for axes in figure.axes for text in axes.texts)
    for one in ranked:
        assert f"{one.rank} pair, {one.pair_id}" in titles


def test_calibrated_parameters_have_the_same_places_and_correlations() -> None:
    evaluation = make_results(
        pairs=9, frames=20, methods=("default", "population", "fixed")
    ).evaluation
    axes = parameter_axes(evaluation)
    spreads = parameter_spreads(evaluation.table, axes)
    assert len(spreads) == len(axes)
    table = correlations(evaluation.table, axes)
    figure = draw_calibration(spreads, table)
    views = calibration_plot(spreads, table).views
    drawn, image = figure.axes[:2]
    for name in ("fixed", "population", "default"):
        places = []
        for line in drawn.lines:
            if line.get_color() == colour_of(name):
                places.append(np.asarray(line.get_xdata(), dtype=float))
        (trace,) = [
            one
            for one in views["values between the bounds"]["data"]
            if one["marker"]["color"] == colour_of(name)
        ]
        np.testing.assert_allclose(np.concatenate(places), numbers(trace["x"]))
    heat = views["rank correlation"]["data"][0]
    values = np.asarray(image.images[0].get_array())
    np.testing.assert_allclose(values, numbers(heat["z"]).reshape(values.shape))
