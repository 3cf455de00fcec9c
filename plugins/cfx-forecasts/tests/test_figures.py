"""Figures of forecasts show the numbers that were chosen."""

from __future__ import annotations

import numpy as np
import pytest

from cfx.figures.colours import colour_of
from cfx_forecasts.distributions import centre_errors, summarize_distributions
from cfx_forecasts.errors import errors_by_history, forecast_methods, summarize_forecasts
from cfx_forecasts.figures import (
    draw_by_history,
    draw_by_horizon,
    draw_distributions,
    pit_density,
)
from tests.drawn import drawn_lines
from tests.made_up import (
    make_distributions,
    make_forecasts,
)


def test_forecasts_have_a_line_per_method() -> None:
    forecasts = make_forecasts()
    summary, methods = summarize_forecasts(forecasts), forecast_methods(forecasts)
    by_horizon = draw_by_horizon(summary, methods).axes
    for axes, error in zip(by_horizon, ("rmse_speed", "rmse_position"), strict=True):
        assert axes.get_yscale() == "log"
        lines = drawn_lines(axes)
        assert len(lines) == len(methods)
        for method in methods:
            rows = summary[summary["method"] == method].sort_values("horizon_s")
            np.testing.assert_allclose(lines[colour_of(method)].get_ydata(), rows[error])


def test_longer_histories_stand_to_the_right() -> None:
    by_history = errors_by_history(make_forecasts())
    figure = draw_by_history(by_history, ["policy"])
    assert len(figure.axes) == 3
    assert figure.axes[-1].get_ylabel().startswith("RMSE of speed after 10 s")
    (line,) = figure.axes[0].lines
    assert bool((np.diff(line.get_xdata()) > 0).all())
    assert bool((np.diff(line.get_ydata()) < 0).all())


def test_distributions_have_lines_and_histograms() -> None:
    forecasts = make_forecasts()
    table = make_distributions(forecasts)
    crps, coverage, pit = draw_distributions(table, forecasts).axes
    summary = summarize_distributions(table)
    shown = {
        "pooled_ar": "pooled_ar",
        "driver_specific_ar": "driver_specific_ar",
        "policy": "policy_sampled",
    }
    for axes, column in ((crps, "crps_speed"), (coverage, "coverage")):
        lines = drawn_lines(axes)
        for method, name in shown.items():
            rows = summary[summary["method"] == method].sort_values("horizon_s")
            np.testing.assert_allclose(lines[colour_of(name)].get_ydata(), rows[column])
    centre = centre_errors(forecasts)["crps_speed"]
    np.testing.assert_allclose(drawn_lines(crps)[colour_of("policy")].get_ydata(), centre)
    assert pit.get_ylabel() == "density, 2 s ahead"
    here = table[table["horizon_s"] == 2.0]
    for method, patch in zip(shown, pit.patches, strict=True):
        density = pit_density(here[here["method"] == method])
        assert density.mean() == pytest.approx(1.0)
        np.testing.assert_allclose(patch.get_data().values, density)
