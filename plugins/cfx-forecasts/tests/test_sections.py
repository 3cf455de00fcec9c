"""What a report's page says of forecasts."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from cfx_forecasts.errors import forecast_methods, forecast_metrics

pytest.importorskip("cfx_report", reason="the page is that of cfx-report")

from cfx_forecasts.sections import crps_sheet, errors
from cfx_report.page import render
from cfx_report.runs import read_runs
from tests.job_folders import write_job
from tests.made_up import make_distributions, make_forecasts
from tests.pages import Page


@pytest.mark.usefixtures("blank_figures")
def test_forecasts_have_plots_and_tables(tmp_path: Path) -> None:
    metrics = write_job(tmp_path / "job", pairs=4)
    forecasts = make_forecasts(drivers=4)
    forecasts.to_parquet(tmp_path / "job" / "forecasts.parquet", index=False)
    found = {**metrics, **forecast_metrics(forecasts)}
    (tmp_path / "job" / "metrics.json").write_text(json.dumps(found))
    page = Page(render(read_runs([str(tmp_path)])))
    assert "forecasts" in page.having("id")
    speed, position = (table for table in page.tables if table[0][0] == "Method")
    assert len(speed) == len(position) == 1 + len(forecast_methods(forecasts))
    (job,) = read_runs([str(tmp_path)]).jobs
    sheet = errors(job, forecasts, "rmse_speed", "m/s")
    name, _, cell, *_ = sheet.rows[0]
    assert name.text == "constant speed"
    key = "forecast/rmse_speed_2s/constant_speed"
    low, high = found[f"{key}/ci95_low"], found[f"{key}/ci95_high"]
    assert cell.text == f"{found[key]:.3f}"
    assert cell.second == f"{low:.3f} to {high:.3f}"


@pytest.mark.usefixtures("blank_figures")
def test_sampled_forecasts_have_a_plot_and_a_table(tmp_path: Path) -> None:
    write_job(tmp_path / "job", pairs=4)
    forecasts = make_forecasts(drivers=4)
    scores = make_distributions(forecasts)
    forecasts.to_parquet(tmp_path / "job" / "forecasts.parquet", index=False)
    scores.to_parquet(tmp_path / "job" / "distributions.parquet", index=False)
    page = Page(render(read_runs([str(tmp_path)])))
    assert "distributions" in page.having("id")
    sheet = crps_sheet(scores, forecasts)
    names = [row[0].text for row in sheet.rows]
    assert names == ["pooled + noise", "driver-specific + noise", "policy, sampled", "policy"]
    sampled, centre = sheet.rows[-2], sheet.rows[-1]
    policy = forecasts[(forecasts["method"] == "policy") & (forecasts["horizon_s"] == 2.0)]
    error = policy["speed_error"].abs().groupby(policy["driver"]).mean().mean()
    assert centre[2].text == f"{error:.3f}"
    assert sampled[2].text == f"{0.67 * error:.3f}"
    assert sampled[2].second.endswith(" %")
    assert centre[2].second == ""
    assert any("PIT" in words for words in page.having("aria-label"))
