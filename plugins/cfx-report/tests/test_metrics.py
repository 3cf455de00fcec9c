"""Metrics of a report come from a job's files, whoever measured them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from cfx.results.result import known_metrics
from cfx_report.runs import read_runs
from cfx_report.section import Sheet
from cfx_report.sections.comparison import every_metric
from cfx_report.sections.results import all_metrics, errors
from tests.job_folders import write_job

from .rendered import page_of

COMFORT: dict[str, Any] = {
    "name": "comfort",
    "unit": "m/s2",
    "direction": "higher",
    "summary": "max",
    "heading": "comfort",
    "meaning": "how gently a vehicle brakes",
    "scopes": ["test", "steady"],
    "headline": True,
    "distribution": "somebodys-metrics",
}


def add_metric(folder: Path, values: dict[str, float]) -> None:
    """Adds a metric that no code here knows to a job's files."""
    data = json.loads((folder / "data.json").read_text())
    data["metrics"] = [*data.get("metrics", []), COMFORT]
    (folder / "data.json").write_text(json.dumps(data))
    metrics = json.loads((folder / "metrics.json").read_text())
    (folder / "metrics.json").write_text(json.dumps(metrics | values))


def rows_of(sheet: Sheet, first: str) -> list[dict[str, str]]:
    found = []
    for row in sheet.rows:
        if row[0].text == first:
            texts = [cell.text for cell in row]
            found.append(dict(zip([c.heading for c in sheet.columns], texts, strict=True)))
    return found


@pytest.mark.usefixtures("blank_figures")
def test_a_metric_of_a_plugin_that_is_not_here_stands_in_the_report(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_job(tmp_path / name, model=name, pairs=4)
    add_metric(tmp_path / "a", {"comfort/policy": 1.25, "comfort/driver_specific": 1.0})
    runs = read_runs([str(tmp_path)])
    with_it, without = runs.jobs
    (row,) = rows_of(all_metrics(with_it), "Comfort (m/s²)")
    assert row["policy"] == "1.25"
    assert row["driver-specific"] == "1"
    assert (row["Better"], row["Over pairs"]) == ("higher", "max")
    assert row["Meaning"] == "how gently a vehicle brakes (of somebodys-metrics)"
    assert not rows_of(all_metrics(without), "Comfort (m/s²)")
    sheet = every_metric(runs.jobs)
    assert sheet is not None
    place = [column.heading for column in sheet.columns].index("Comfort (m/s²)")
    assert [row[place].text for row in sheet.rows] == ["1.25", "\N{EN DASH}"]
    assert sheet.rows[0][place].second == "1"
    assert "how gently a vehicle brakes" in page_of(tmp_path).words


def test_a_metric_that_metrics_json_lacks_is_summarised_from_its_pairs(tmp_path: Path) -> None:
    write_job(tmp_path / "job", pairs=3)
    add_metric(tmp_path / "job", {"comfort/default": 2.0})
    values = pd.DataFrame(
        {
            "pair_id": ["a", "b", "a"],
            "driver": "d",
            "method": ["policy", "policy", "driver_specific"],
            "scope": "test",
            "metric": "comfort",
            "value": [0.5, 0.75, float("nan")],
        }
    )
    values.to_parquet(tmp_path / "job" / "pair_metrics.parquet", index=False)
    (job,) = read_runs([str(tmp_path)]).jobs
    assert job.metric("comfort", "policy") == 0.75
    assert job.metric("comfort", "default") == 2.0
    assert pd.isna(job.metric("comfort", "driver_specific"))
    assert pd.isna(job.metric("comfort", "policy", "steady"))


def test_the_error_to_expect_stands_beside_the_errors(tmp_path: Path) -> None:
    write_job(tmp_path / "a", model="a", pairs=4)
    (job,) = read_runs([str(tmp_path / "a")]).jobs
    heading = "Expected of 90 % of drivers (m/s)"
    assert heading not in [column.heading for column in errors([job]).columns]
    add_metric(tmp_path / "a", {"past/bound/policy": 1.357, "past/bound/driver_specific": 1.592})
    (job,) = read_runs([str(tmp_path / "a")]).jobs
    found = {row["Method"]: row[heading] for row in rows_of(errors([job]), job.name)}
    assert (found["policy"], found["driver-specific"]) == ("1.357", "1.592")


@pytest.mark.usefixtures("blank_figures")
def test_a_metric_that_could_not_be_measured_is_told(tmp_path: Path) -> None:
    write_job(tmp_path / "job", pairs=3)
    path = tmp_path / "job" / "data.json"
    left_out = [{"name": "m", "distribution": "theirs", "reason": "it has a shape of its own"}]
    path.write_text(json.dumps(json.loads(path.read_text()) | {"metrics_left_out": left_out}))
    assert "m of theirs could not be measured: it has a shape of its own" in page_of(tmp_path).words


@pytest.mark.parametrize("listed", [None, [], ["nonsense"], [{"name": "rmse_speed"}]])
def test_jobs_that_say_little_of_their_metrics_are_read(listed: Any) -> None:
    data = {} if listed is None else {"metrics": listed}
    known = known_metrics(data, {"rmse_speed/policy": 1.0, "full_trajectory/rmse_speed/policy": 1})
    assert known == ()
