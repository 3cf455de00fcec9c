"""A third party's metric stands wherever cfx's own do, and a broken one costs a job nothing."""

from __future__ import annotations

import csv
import io
import json
import logging
import re
from pathlib import Path

import pandas as pd
import pytest
from rich.console import Console

import cfx
from cfx.app.job.console import methods_table
from cfx.app.sweep.folder import JobStatus
from cfx.app.sweep.summary import SweepSummary
from cfx.errors import PluginError
from cfx.evaluation.metrics.base import ALWAYS, MetricSet
from tests.broken_plugins import QUICK
from tests.installer import Installer

GOOD = """
from cfx.plugin import Metric

class Good(Metric):
    unit = "m"
    direction = "none"
    heading = "mean gap"
    meaning = "mean of the simulated gap"
    is_of_recording = True

    def compute(self, trajectories):
        gap = trajectories.gap.masked_fill(~trajectories.counted, 0.0)
        return gap.sum(1) / trajectories.counted.sum(1)
"""


def plugin(install: Installer, name: str, code: str) -> None:
    """Installs a distribution `NAME-metrics` that brings one metric."""
    module = f"metric_{name}"
    install(
        f"{name.replace('_', '-')}-metrics",
        {"cfx.metrics": {name: f"{module}:Good"}, "cfx.api": {"1": module}},
        {f"{module}.py": code},
    )


def broken(body: str) -> str:
    """Returns the metric with another last line."""
    return GOOD.replace("return gap.sum(1) / trajectories.counted.sum(1)", body)


def test_a_plugins_metric_stands_in_every_result(
    install: Installer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    plugin(install, "mean_gap", GOOD)
    store = f"sqlite:///{tmp_path / 'mlflow.db'}"
    overrides = [one for one in QUICK if not one.startswith("tracking")]
    result = cfx.run([*overrides, f"tracking.uri={store}", "metrics=[own,mean_gap]"])

    assert result.metrics["mean_gap/driver_specific"] > 0
    assert result.metrics["mean_gap/real"] > 0
    written = json.loads((result.folder / "metrics.json").read_text())
    assert written["mean_gap/driver_specific"] == result.metrics["mean_gap/driver_specific"]

    pairs = pd.read_csv(result.folder / "pairs.csv")
    of_fixed = pairs.loc[pairs["method"] == "driver_specific"]
    assert of_fixed["mean_gap"].mean() == pytest.approx(result.metrics["mean_gap/driver_specific"])
    assert of_fixed["real_mean_gap"].mean() == pytest.approx(result.metrics["mean_gap/real"])
    values = pd.read_parquet(result.folder / "pair_metrics.parquet")
    scopes = values.loc[values["metric"] == "mean_gap", "scope"]
    assert set(scopes) == {"test", "steady"}

    said = json.loads((result.folder / "data.json").read_text())
    (info,) = [one for one in said["metrics"] if one["name"] == "mean_gap"]
    assert (info["heading"], info["unit"], info["scopes"]) == ("mean gap", "m", ["test"])
    assert info["distribution"] == "mean-gap-metrics"

    from mlflow import MlflowClient

    run = MlflowClient(store).get_run(result.run_id)
    assert run.data.metrics["mean_gap_m"] == pytest.approx(written["mean_gap/driver_specific"])
    assert run.data.tags["cfx.plugin.mean-gap-metrics"] == "1.0"

    out = io.StringIO()
    Console(file=out, width=120).print(methods_table(result))
    assert re.search(r"mean .*gap .*\[m\]", out.getvalue(), re.DOTALL)


def test_a_plugins_metric_stands_in_the_summary_of_a_sweep(tmp_path: Path) -> None:
    usual = {"direction": "none", "summary": "mean", "meaning": "", "scopes": ["test"]}
    usual["distribution"] = "theirs"
    info = {**usual, "name": "mean_gap", "unit": "m", "heading": "mean gap", "headline": True}
    hidden = {**usual, "name": "theil_u", "unit": "", "heading": "Theil's U", "headline": False}
    statuses = {}
    for name, value in {"a": 12.5, "b": 13.5}.items():
        folder = tmp_path / name
        folder.mkdir()
        metrics = {
            "rmse_speed/policy": 0.5,
            "improvement/rmse_speed/driver_specific/geometric": 0.1,
            "mean_gap/policy": value,
            "theil_u/policy": 0.01,
        }
        (folder / "metrics.json").write_text(json.dumps(metrics))
        (folder / "data.json").write_text(json.dumps({"metrics": [info, hidden]}))
        statuses[folder] = JobStatus(0, "", "", (f"model={name}",))
    # A job may say nothing of its metrics.
    old = tmp_path / "old"
    old.mkdir()
    (old / "metrics.json").write_text(
        json.dumps({"improvement/rmse_speed/driver_specific/geometric": 0.2})
    )
    (old / "data.json").write_text("{}")
    statuses[old] = JobStatus(0, "", "", ("model=old",))

    summary = SweepSummary.of(statuses)
    summary.write(tmp_path / "summary.csv")
    with (tmp_path / "summary.csv").open() as file:
        read = list(csv.DictReader(file))
    assert [row["mean_gap"] for row in read] == ["12.5", "13.5", ""]
    assert [row["theil_u"] for row in read] == ["0.01", "0.01", ""]
    out = io.StringIO()
    Console(file=out, width=200, markup=False).print(summary.table())
    assert "mean gap [m]" in out.getvalue()
    assert "13.500" in out.getvalue()
    assert "Theil" not in out.getvalue()


BROKEN = {
    "raises": "raise RuntimeError('no luck')",
    "unmade": GOOD.replace("compute", "measure"),
    "unsaid": GOOD.replace('    unit = "m"\n', ""),
    "sideways": GOOD.replace('"none"', '"sideways"'),
    "of_frames": broken("return gap"),
    "settled": GOOD.replace(
        "class Good(Metric):",
        "from cfx.plugin import Settings\nclass Own(Settings):\n    x: int = 1\n"
        "class Good(Metric):\n    schema = Own",
    ),
    "improvement": GOOD,
    # The two that only a job's own trajectories bring out.
    "picky": broken("assert len(gap) == 4, 'four pairs'\n        return gap.sum(1)"),
    "shapeless": broken("return gap.sum(1) if len(gap) == 4 else gap"),
}


def test_broken_metrics_are_left_out_told_and_counted(
    install: Installer,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, code in BROKEN.items():
        plugin(install, name, code)
    plugin(install, "mean_gap", GOOD)
    with caplog.at_level(logging.WARNING, logger="cfx"):
        result = cfx.run([*QUICK, "metrics=all"])
    assert "mean_gap/driver_specific" in result.metrics
    said = json.loads((result.folder / "data.json").read_text())
    assert {one["name"] for one in said["metrics_left_out"]} == set(BROKEN)
    for name in BROKEN:
        assert f"{name}/driver_specific" not in result.metrics
        distribution = f"{name.replace('_', '-')}-metrics"
        warned = [record for record in caplog.records if distribution in record.getMessage()]
        assert len(warned) == 1, name


def test_a_metric_that_is_named_must_be_there_and_work(install: Installer) -> None:
    plugin(install, "unsaid", BROKEN["unsaid"])
    plugin(install, "mean_gap", GOOD)
    with pytest.raises(
        PluginError, match=r"there is no metric 'mean_gab'\. Did you mean 'mean_gap'"
    ):
        MetricSet.of(["mean_gab"])
    with pytest.raises(PluginError, match=r"unsaid-metrics 1\.0.* must say its `unit`"):
        MetricSet.of(["unsaid"])
    chosen = [one.name for one in MetricSet.of(["mean_gap"]).metrics]
    assert chosen == [*ALWAYS, "mean_gap"]


def test_cfxs_own_metric_cannot_be_replaced(install: Installer) -> None:
    plugin(install, "rmse_speed", "raise SystemExit(1)")
    found = {one.name: one.distribution for one in MetricSet.of("all").metrics}
    assert found["rmse_speed"] == "cfx-driving"


def test_what_is_installed_is_not_measured_unless_it_is_named(install: Installer) -> None:
    """So that the columns of a job's files do not depend on the machine."""
    own = [one.name for one in MetricSet.of().metrics]
    plugin(install, "mean_gap", GOOD)
    assert [one.name for one in MetricSet.of().metrics] == own
    assert {one.name for one in MetricSet.of(["own", "mean_gap"]).metrics} == {*own, "mean_gap"}
