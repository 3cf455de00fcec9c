"""The figure of errors over time shows those of the pairs that still drive."""

from __future__ import annotations

import dataclasses

import numpy as np

from cfx.figures.colours import colour_of
from cfx.figures.drawing import draw_figure, figure_named
from cfx.results.result import Result
from cfx_report.figures.error_over_time import draw_errors, errors_over_time
from tests.drawn import drawn_lines, texts
from tests.made_up import make_results


def test_errors_over_time_show_where_the_transient_ends() -> None:
    evaluation = make_results(pairs=5, frames=80).evaluation
    figure = draw_errors(evaluation.trajectories, evaluation.methods, 5.0)
    for axes, signal in zip(figure.axes, ("speed", "gap"), strict=True):
        lines = drawn_lines(axes)
        for method in evaluation.methods:
            _, error = errors_over_time(evaluation.trajectories, method, signal)
            np.testing.assert_allclose(lines[colour_of(method)].get_ydata(), error)
        assert [5.0, 5.0] in [list(line.get_xdata()) for line in axes.lines]


def test_errors_over_time_are_those_of_the_pairs_that_still_drive() -> None:
    drives = make_results(pairs=4, frames=30).evaluation.trajectories
    shortened = [
        dataclasses.replace(
            d,
            time=d.time[:11],
            real_speed=d.real_speed[:11],
            speed={"policy": d.speed["policy"][:11]},
        )
        for d in drives[:1]
    ]
    seconds, error = errors_over_time(drives, "policy", "speed")
    expected = np.sqrt(np.mean([(d.speed["policy"] - d.real_speed) ** 2 for d in drives], axis=0))
    np.testing.assert_allclose(error, expected)
    assert seconds[0] == 0
    assert error[0] == 0
    seconds, _ = errors_over_time(
        [shortened[0], *drives[1:]], "policy", "speed"
    )  # three of four are not nearly all
    assert len(seconds) == 11
    results = Result.of(make_results(pairs=3).evaluation)
    figure = draw_figure(figure_named("error_over_time"), results)
    assert figure is not None
    assert "time since the test part began" in texts(figure)
