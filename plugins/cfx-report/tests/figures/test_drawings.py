"""The figures draw whatever an evaluation can hold, without a warning, and show what they say."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import imread

from cfx.core import registry
from cfx.core.parameters import Parameter, ParameterSpace
from cfx.errors import ConfigError, OutputError
from cfx.evaluation.result import Evaluation, Purpose
from cfx.figures.colours import COLOURS
from cfx.figures.drawing import draw_figure, figure_named, write_figure, write_figures
from cfx.figures.wording import percent, pretty_unit, shortened, unit_label
from cfx.learners.curves import over_networks
from cfx.results.figures.learning_curve import SAMPLED
from cfx.results.figures.pair_lines import drives
from cfx.results.result import Result
from cfx_report.figures.history import amounts_of
from cfx_report.figures.platoon import braking_time, worst_platoon
from tests.drawn import texts
from tests.made_up import GAINS, MadeUp, make_history, make_platoon, make_results

TEN = ParameterSpace.of(
    *(Parameter(f"p{k}", "m/s2", -2.0, 3.0 + k, 1.0, "made up") for k in range(10))
)

SHOWN = [one for one in registry.installed("figure") if one.distribution != "cfx-example"]
"""All figures but the example's."""


def all_of(made: MadeUp) -> Result:
    return Result.of(made.evaluation, tables={"curves": made.curves})


def drawn(name: str, results: Result) -> Figure:
    found = draw_figure(figure_named(name), results)
    assert found is not None
    return found


def learned(curves: pd.DataFrame) -> Result:
    return dataclasses.replace(all_of(make_results(pairs=1, frames=5)), tables={"curves": curves})


def unrendered(canvas: FigureCanvasAgg, file: Path, **options: object) -> None:
    """Stands for Matplotlib's pixels where only names of files are looked at."""
    file.touch()


def with_improvement(results: MadeUp, gains: dict[int, float]) -> Evaluation:
    """Returns results in which some pairs' improvements are replaced."""
    values = results.evaluation.values.copy()
    speed = values["metric"] == "rmse_speed"
    before = values.loc[speed & (values["method"] == "driver_specific"), "value"].to_numpy()
    rows = values.index[speed & (values["method"] == "policy")]
    for k, value in gains.items():
        values.loc[rows[k], "value"] = before[k] * (1 - value)
    return dataclasses.replace(results.evaluation, values=values)


@pytest.mark.parametrize(
    ("options", "files"),
    [
        pytest.param({"pairs": 1, "epochs": 1}, 10, marks=pytest.mark.slow),
        pytest.param({"pairs": 94, "frames": 40, "space": TEN}, 11, marks=pytest.mark.slow),
        ({"pairs": 2, "frames": 1, "networks": 0}, 9),
        ({"pairs": 26, "methods": ("default", "pooled", "driver_specific", "policy")}, 11),
    ],
    ids=[
        "one pair",
        "94 pairs and ten parameters",
        "one frame and nothing learned",
        "four methods",
    ],
)
def test_every_size_of_job_is_drawn(tmp_path: Path, options: dict[str, Any], files: int) -> None:
    results = make_results(**options)
    paths = write_figures(tmp_path / "figures", all_of(results), SHOWN)
    assert len(paths) == files == len(list((tmp_path / "figures").iterdir()))
    for path in paths:
        height, width = imread(path).shape[:2]
        assert width == 1575
        assert 300 < height < 1400


@pytest.mark.parametrize("count", range(1, 11))
def test_chosen_parameters_have_an_axis_each(count: int) -> None:
    space = ParameterSpace(TEN.parameters[:count])
    found = drawn("chosen_parameters", all_of(make_results(pairs=3, frames=20, space=space)))
    assert len(found.axes) == len(space.names) + 1
    written = texts(found)
    assert all(f"{name} (m/s²)" in written for name in space.names)


def test_undefined_improvements_are_counted_and_not_drawn() -> None:
    results = make_results(pairs=5, frames=20)
    some = drawn(
        "improvement_per_driver", Result.of(with_improvement(results, {1: np.nan, 2: -np.inf}))
    )
    assert "3 pairs" in texts(some)
    assert "2 without a defined improvement" in texts(some)
    none = Result.of(with_improvement(results, dict.fromkeys(range(5), np.nan)))
    for found, words in (
        (drawn("improvement_per_driver", none), "no pair has a defined improvement"),
        (drawn("drives", none), "improvement undefined"),
        (drawn("chosen_parameters", none), "pair "),
    ):
        found.canvas.draw()
        assert words in texts(found)


def test_an_outlier_is_labelled_and_does_not_shrink_the_others() -> None:
    results = make_results(pairs=20, frames=20)
    tame = with_improvement(results, {k: 0.3 - 0.02 * k for k in range(20)})
    wild = with_improvement(dataclasses.replace(results, evaluation=tame), {19: -7.0})
    found = drawn("improvement_per_driver", Result.of(wild))
    assert "\N{MINUS SIGN}700 %" in texts(found)
    assert found.axes[0].get_ylim()[0] > -2.0


def test_drives_shows_best_median_and_worst() -> None:
    results = make_results(pairs=7, frames=20)
    evaluation = with_improvement(results, {k: 0.1 * k for k in range(7)})
    ids = [drive.pair_id for drive in evaluation.trajectories]
    written = texts(drawn("drives", Result.of(evaluation)))
    for rank, k in (("best", 6), ("median", 3), ("worst", 0)):
        assert f"{rank} pair, {ids[k]}:  {percent(0.1 * k)}" in written
    one = drives(Result.of(evaluation), pair_id=ids[2])
    assert len(one.axes) == 2
    rows = evaluation.table[
        (evaluation.table["pair_id"] == ids[2]) & (evaluation.table["method"] == "driver_specific")
    ]
    assert f"driver-specific {float(rows['rmse_speed'].iloc[0]):.2f}" in texts(one)
    colours = {line.get_color() for line in one.axes[0].lines}
    assert colours == {COLOURS[signal] for signal in ("real", "leader", *evaluation.methods)}


def test_an_unknown_pair_is_named_with_the_nearest() -> None:
    evaluation = make_results(pairs=3, frames=20).evaluation
    with pytest.raises(
        ConfigError, match=r"pair 'i80-0400-1000-99' is not .* Did you mean 'i80-0400-1000-990'"
    ):
        drives(Result.of(evaluation), pair_id="i80-0400-1000-99")


def test_a_default_driver_far_away_does_not_shrink_the_others() -> None:
    evaluation = make_results(pairs=1, frames=50).evaluation
    drive = evaluation.trajectories[0]
    far = dataclasses.replace(
        drive, gap={**drive.gap, "default": drive.real_gap + np.linspace(0, 500, 51)}
    )
    found = drives(Result.of(dataclasses.replace(evaluation, trajectories=(far,))))
    assert found.axes[1].get_ylim()[1] < 120
    assert "default up to" in texts(found)


def test_a_collision_is_marked_and_a_diverged_drive_is_survived() -> None:
    evaluation = make_results(pairs=1, frames=50).evaluation
    drive = evaluation.trajectories[0]
    bad = dataclasses.replace(
        drive,
        gap={
            **drive.gap,
            "policy": drive.real_gap - np.linspace(0, 20, 51),
            "driver_specific": np.full(51, np.inf),
        },
        speed={**drive.speed, "driver_specific": np.full(51, np.nan)},
    )
    found = drives(Result.of(dataclasses.replace(evaluation, trajectories=(bad,))))
    found.canvas.draw()
    assert "policy collides" in texts(found)


def test_names_are_text_and_never_formulas(tmp_path: Path) -> None:
    results = make_results(pairs=1, frames=20)
    name = "50$ \\frac{1}{0} $ 跟车 " + "x" * 80
    evaluation = dataclasses.replace(
        results.evaluation,
        about=results.evaluation.about.assign(pair_id=name),
        values=results.evaluation.values.assign(pair_id=name),
        trajectories=(dataclasses.replace(results.evaluation.trajectories[0], pair_id=name),),
    )
    odd = Result.of(evaluation, tables={"curves": results.curves})
    assert len(write_figures(tmp_path, odd, SHOWN)) == 10


def test_cuts_and_cluster_sizes_stand_in_the_style_figure() -> None:
    made = make_results(pairs=94, frames=5)
    style = made.style
    written = texts(drawn("style_distribution", all_of(made)))
    for cut in style.cuts:
        assert f"{cut:.3f}" in written
    for name, count in style.table["cluster_name"].value_counts().items():
        assert f"{name}: {count}" in written
    lost = dataclasses.replace(style, table=style.table.assign(score=np.nan))
    assert "94 drivers without a score" in texts(
        drawn("style_distribution", Result.of(dataclasses.replace(made.evaluation, style=lost)))
    )


def test_a_network_that_stopped_early_keeps_its_last_loss() -> None:
    curves = pd.DataFrame(
        {
            "network": ["a", "a", "b", "b", "b"],
            "epoch": [0, 1, 0, 1, 2],
            "train_loss": [4.0, 2.0, 8.0, 6.0, 5.0],
            "validation_loss": np.nan,
        }
    )
    assert over_networks(curves, "train_loss").loc[2].tolist() == [2.0, 5.0]
    assert over_networks(curves, "validation_loss").empty
    assert "2 networks: median and quartiles" in texts(drawn("learning_curve", learned(curves)))


def test_learning_curves_say_where_sampled_paths_begin_to_count() -> None:
    losses = {"network": "a", "epoch": range(4), "train_loss": [2.0, 1.0, 3.0, 2.0]}
    curves = pd.DataFrame(losses).assign(validation_loss=np.nan)
    assert SAMPLED not in texts(drawn("learning_curve", learned(curves)))
    curves["sampled_paths"] = [0, 0, 2, 2]
    assert SAMPLED in texts(drawn("learning_curve", learned(curves)))


@pytest.mark.parametrize("loss", [np.nan, 0.0, -1.0, np.inf])
def test_a_loss_that_no_logarithm_takes_is_drawn(loss: float) -> None:
    epochs = np.arange(5)
    curves = pd.DataFrame(
        {
            "network": "a",
            "epoch": epochs,
            "train_loss": np.where(epochs == 2, loss, 10.0**-epochs),
            "validation_loss": np.nan,
        }
    )
    drawn("learning_curve", learned(curves)).canvas.draw()


def test_a_path_that_cannot_be_written_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    results = make_results(pairs=1, frames=10)
    with pytest.raises(
        OutputError, match=r"improvement_per_driver\.png: this figure cannot be written"
    ):
        write_figures(tmp_path / "file" / "figures", all_of(results), SHOWN)


def test_labels() -> None:
    assert percent(-0.1234, 1) == "\N{MINUS SIGN}12.3 %"
    assert pretty_unit("1e-4/(m s)") == "10⁻⁴/(m s)"
    assert unit_label("k", "1") == "k"
    assert shortened("abcdefghij", 7) == "abc…hij"


def test_each_method_has_its_own_speed_plot() -> None:
    evaluation = make_results(
        pairs=3, methods=("default", "pooled", "driver_specific", "policy")
    ).evaluation
    found = drawn("speeds", Result.of(evaluation))
    assert len(found.axes) == 4
    row = evaluation.table[evaluation.table["method"] == "pooled"].sort_values(
        "improvement_over_driver_specific"
    )
    assert any(f"{value:.3f} m/s" in texts(found) for value in row["rmse_speed"])


def test_a_panel_per_method_shows_the_worst_platoon() -> None:
    platoon = make_platoon({"default": 1, "policy": 3})
    results = Result.of(
        make_results(pairs=1, frames=5).evaluation,
        tables={"platoon": platoon.table},
        metrics=platoon.metrics(),
    )
    found = drawn("platoon", results)
    found.canvas.draw()
    default, policy = found.axes
    assert "string stable" in default.get_title(loc="left")
    assert "2 of 3 platoons are string stable" in policy.get_title(loc="left")
    assert f"{0.9**10:.3f} times the leader's drop" in default.get_title(loc="left")
    assert "not defined, as vehicles collide" in policy.get_title(loc="left")
    for axes in (default, policy):
        assert len([line for line in axes.lines if len(line.get_xdata()) > 1]) == 11
    # In fold 2 followers collide from its fifth follower on; fold 0, which `default` has, never.
    assert len([line for line in policy.lines if line.get_marker() == "X"]) == 6
    assert not [line for line in default.lines if line.get_marker() == "X"]
    rows, network = worst_platoon(platoon.table[platoon.table["method"] == "policy"])
    assert network == "fold 2"
    assert braking_time(rows) == 12.0


def test_history_is_drawn_from_least_to_most_with_its_intervals() -> None:
    history = make_history(make_results(pairs=6, frames=20).evaluation.trajectories, GAINS)
    assert amounts_of(history) == ["0 s", "10 s", "80 %"]
    # A drive may be shorter than the longest amount in seconds.
    shortened = history.assign(
        history_s=history["history_s"].where(~history["amount"].str.endswith("%"), 8.0)
    )
    assert amounts_of(shortened) == ["0 s", "10 s", "80 %"]
    made = all_of(make_results(pairs=1, frames=5))
    (axes,) = drawn("history", dataclasses.replace(made, tables={"history": history})).axes
    own, pooled = axes.containers
    assert list(own.lines[0].get_ydata()) == pytest.approx([-0.1, 0.1, 0.2], abs=1e-3)
    assert list(pooled.lines[0].get_ydata()) == pytest.approx([0.05], abs=1e-3)
    (low, high) = own.lines[2][0].get_segments()[0][:, 1]
    assert low < -0.1 < high


def test_platoon_and_history_are_written_where_a_protocol_delivered_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(FigureCanvasAgg, "print_png", unrendered)
    results = make_results(pairs=3, frames=20)
    history = make_history(results.evaluation.trajectories, GAINS)
    platoon = make_platoon({"policy": 2})
    tables = {"curves": results.curves, "platoon": platoon.table, "history": history}
    every = Result.of(results.evaluation, tables=tables)
    names = {path.name for path in write_figures(tmp_path, every, SHOWN)}
    assert {"platoon.png", "history.png"} <= names
    assert len(names) == 13


def test_a_policy_that_does_not_adapt_has_no_figure_of_improvements() -> None:
    made = make_results(pairs=3, frames=20)
    values = made.evaluation.values
    same = values[values["method"] == "driver_specific"].assign(method="policy")
    values = pd.concat([values[values["method"] != "policy"], same], ignore_index=True)
    made = dataclasses.replace(
        made,
        evaluation=dataclasses.replace(made.evaluation, values=values, purpose=Purpose.CALIBRATION),
    )
    still = all_of(made)
    assert draw_figure(figure_named("improvement_per_driver"), still) is None
    assert draw_figure(figure_named("calibration"), still) is not None
    # Its policy is one of the constant sets: it is no line of its own, and improves nothing.
    written = texts(drawn("drives", still))
    assert "policy" not in written
    assert "%" not in written
    assert "improvement" not in written
    assert "policy" not in texts(drawn("speeds", still))
    errors = made.evaluation.table.query("method == 'driver_specific'").set_index("pair_id")[
        "rmse_speed"
    ]
    assert f"best pair, {errors.idxmin()}" in written.lower()


def test_figures_for_a_paper_are_vector_graphics_without_dates(tmp_path: Path) -> None:
    every = all_of(make_results(pairs=2, frames=10))
    first, again = [], []
    for written in (first, again):
        for form in ("svg", "pdf"):
            path = write_figure(drawn("speeds", every), tmp_path / f"speeds.{form}")
            written.append(path.read_bytes())
    assert again == first
    svg, pdf = first
    assert b"<svg" in svg
    assert pdf.startswith(b"%PDF-")
    assert b"TrueType" in pdf or b"CIDFontType2" in pdf
