"""A finished job as its folder holds it, from which figures and reports are made.

A metric of a plugin that is not installed here is known from `data.json` alone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from pydantic import TypeAdapter, ValidationError

from cfx.core.job_folder import (
    examine,
    optional,
    public,
    read_json,
    read_metrics,
    read_yaml,
    read_yaml_list,
)
from cfx.data.style import StyleResult
from cfx.errors import DataError, without_passwords
from cfx.evaluation.headline import improvement_key
from cfx.evaluation.metrics.base import SUMMARIES, MetricInfo, column_of, key_of
from cfx.evaluation.result import METHODS, PairTrajectory, Purpose
from cfx.evaluation.statistics import STATISTICS, Improvement
from cfx.evaluation.tables import scope_label
from cfx.figures.figure import ParameterAxis, Results
from cfx.figures.text import TEST
from cfx.results.table import file_of, installed, read_tables
from cfx.results.tracker import Origin
from cfx.simulation.trajectory import TRANSIENT_S

OUTSIDE = "outside_range"
"""A metric that says nothing of constant parameters."""


@dataclass(frozen=True)
class Job:
    """One finished job.

    Attributes:
        place: where it was read: its folder, or its MLflow run.
        config: the resolved configuration.
        data: where the pairs came from, what was left out, what was measured (`data.json`).
        metrics: under their MLflow names; NaN where a metric is not defined.
        tables: what its installed tables hold, by name (`cfx.results.table`); `pairs` is there.
        overrides: what was typed; None if that is not known.
        experiment: the preset that was chosen, "" for none; None if that is not known.
        started: when it began; None if that is not known.
        seconds: how long it took; None if that is not known.
        version: of cfx; "" if that is not known.
        missing: files that jobs have and this one has not.
        name: what tells it from the others of one report.
    """

    place: str
    config: Mapping[str, Any]
    data: Mapping[str, Any]
    metrics: Mapping[str, float]
    tables: Mapping[str, pd.DataFrame]
    overrides: tuple[str, ...] | None = None
    experiment: str | None = None
    started: datetime | None = None
    seconds: float | None = None
    version: str = ""
    missing: tuple[str, ...] = ()
    name: str = ""

    def component(self, group: str) -> str:
        """Returns the name of a component, of the group "model" for instance "w99".

        It is "" for the learner of a job that trains nothing, whatever its configuration says.
        """
        if group == "learner" and self.setting("protocol.run"):
            return ""
        node = self.config.get(group)
        return str(node.get("name", "")) if isinstance(node, Mapping) else ""

    def setting(self, path: str) -> Any:
        """Returns a setting such as "style.cluster"; None if the job has none of that name."""
        value: Any = self.config
        for key in path.split("."):
            value = value.get(key) if isinstance(value, Mapping) else None
        return value

    @property
    def pairs(self) -> pd.DataFrame:
        """A row per pair and method; SI units; `cluster` by name."""
        return self.tables["pairs"]

    @property
    def methods(self) -> tuple[str, ...]:
        """The methods that were compared, in the order in which they are shown."""
        present = self.pairs["method"].astype(str).unique().tolist()
        known = [method for method in METHODS if method in present]
        return (*known, *(method for method in present if method not in METHODS))

    @property
    def meaningful_methods(self) -> tuple[str, ...]:
        """The methods whose numbers say something of their own.

        Without a constant baseline that is only the policy; a calibration's policy is one of its
        constant sets once more.
        """
        if self.purpose is Purpose.POLICY:
            return ("policy",)
        constant = tuple(method for method in self.methods if method != "policy")
        return constant if self.purpose is Purpose.CALIBRATION and constant else self.methods

    @property
    def judged(self) -> str:
        """The method whose numbers the job is judged by: the policy; of a calibration `fixed`."""
        for method in ("policy", "fixed", "population"):
            if method in self.meaningful_methods:
                return method
        return "default"

    @property
    def errors(self) -> pd.DataFrame:
        """A row per pair, by the method that the job is judged by: `pair_id`, `driver`, `frames`.

        `error` is its RMSE of speed on the test part, m/s.
        """
        rows = self.pairs[self.pairs["method"] == self.judged]
        return rows[["pair_id", "driver", "frames", "rmse_speed"]].rename(
            columns={"rmse_speed": "error"}
        )

    @property
    def purpose(self) -> Purpose:
        """What its numbers say."""
        found = self.data.get("purpose")
        return Purpose(found) if found in set(Purpose) else Purpose.ADAPTATION

    def metric(self, name: str, method: str, scope: str = TEST) -> float:
        """Returns a metric of a method over a part of the trajectories; NaN if it is not known."""
        key = key_of(name, method, scope)
        if key in self.metrics:
            return self.metrics[key]
        return self._summaries.get((name, method, scope), math.nan)

    def has_metric(self, name: str, method: str, scope: str = TEST) -> bool:
        """Says whether a metric was measured, for the policy or for one of `meaningful_methods`."""
        known = (*self.meaningful_methods, "policy")
        return method in known and key_of(name, method, scope) in self.metrics

    @cached_property
    def known_metrics(self) -> tuple[MetricInfo, ...]:
        """What the job measured, in the order in which it is shown."""
        found = known_metrics(self.data, self.metrics)
        if self.purpose is Purpose.CALIBRATION:
            return tuple(one for one in found if one.name != OUTSIDE)
        return found

    @cached_property
    def _summaries(self) -> dict[tuple[str, str, str], float]:
        """Metrics by name, method and scope, summarised from the values of the pairs."""
        found: dict[tuple[str, str, str], float] = {}
        if "pair_metrics" not in self.tables:
            return found
        kinds = {metric.name: metric.summary for metric in self.known_metrics}
        for key, rows in self.tables["pair_metrics"].groupby(["metric", "method", "scope"]):
            name, method, scope = map(str, key)
            summary = rows["value"].dropna().agg(kinds.get(name, "mean"))
            found[name, method, scope] = float(summary)
        return found

    def improvement(self, statistic: str, baseline: str = "fixed", scope: str = TEST) -> float:
        """Returns a statistic of the improvement over a baseline, a fraction; NaN if unknown."""
        return self.metrics.get(f"{improvement_key(baseline, scope)}/{statistic}", math.nan)

    def baselines(self, scope: str = TEST) -> tuple[str, ...]:
        """Returns what the policy was compared with, driver-specific calibration first.

        It is empty if the job has another purpose.
        """
        if self.purpose is not Purpose.ADAPTATION:
            return ()
        found: list[str] = []
        for method in ("fixed", *self.methods):
            known = f"{improvement_key(method, scope)}/mean" in self.metrics
            if known and method in self.methods and method not in {*found, "policy"}:
                found.append(method)
        return tuple(found)

    @property
    def split(self) -> float:
        """Share of each pair that was calibrated on; NaN if that is not known."""
        split = self.config.get("split")
        return float(split) if isinstance(split, int | float) else math.nan

    @property
    def transient_s(self) -> float:
        """Length of the transient at the beginning of the test part, s."""
        return float(self.data.get("transient_s", TRANSIENT_S))

    @property
    def outside(self) -> dict[str, str]:
        """How much the policy drove outside what it has learned from, in words by scope."""
        return dict(self.data.get("outside") or {})

    def scope_label(self, scope: str) -> str:
        """Returns how a part of the trajectories is named."""
        return scope_label(scope, self.transient_s)

    @cached_property
    def by_pair(self) -> pd.DataFrame:
        """A row per pair.

        Columns: pair_id, driver, cluster, style_score, `rmse_speed/METHOD`, `rmse_gap/METHOD`,
        `improvement/BASELINE`.
        """
        first = self.pairs.drop_duplicates("pair_id").set_index("pair_id")
        table = first.filter(items=["driver", "cluster", "style_score"])
        for method in self.methods:
            rows = self.pairs[self.pairs["method"] == method]
            of_method = rows.drop_duplicates("pair_id").set_index("pair_id")
            for column in ("rmse_speed", "rmse_gap"):
                table[f"{column}/{method}"] = of_method[column]
        rows = self.pairs[self.pairs["method"] == "policy"]
        of_policy = rows.drop_duplicates("pair_id").set_index("pair_id")
        for baseline in self.methods:
            column = "improvement" if baseline == "fixed" else f"improvement_over_{baseline}"
            if column in of_policy:
                table[f"improvement/{baseline}"] = of_policy[column]
        return table.reset_index()

    @property
    def parameters(self) -> tuple[ParameterAxis, ...]:
        """The tuned parameters, as `data.json` describes them."""
        axes = []
        for about in self.data.get("parameters") or ():
            low, high = _number(about.get("low")), _number(about.get("high"))
            unit, meaning = str(about.get("unit", "")), str(about.get("meaning", ""))
            axes.append(ParameterAxis(str(about.get("name")), unit, low, high, meaning))
        return tuple(axes)

    @cached_property
    def results(self) -> Results:
        """What the job's figures are drawn from."""
        return Results(
            pairs=self.pairs,
            methods=self.meaningful_methods,
            parameters=self.parameters,
            trajectories=self.pair_trajectories,
            improvements={one: self.statistics(one) for one in self.baselines()},
            style=self._style_result,
            tables=self.tables,
            metrics=self.metrics,
            transient_s=self.transient_s,
        )

    def statistics(self, baseline: str, scope: str = TEST) -> Improvement:
        """Returns the improvement over one of `baselines`; NaN where a statistic is not known."""
        statistics = {name: self.improvement(name, baseline, scope) for name in STATISTICS}
        known = self._improved(baseline, scope)
        undefined, drivers = len(self.by_pair) - known, self.by_pair["driver"].nunique()
        return Improvement(**statistics, pairs=known, undefined=undefined, drivers=drivers)

    def _improved(self, baseline: str, scope: str) -> int:
        """Returns the number of pairs whose improvement over a baseline is defined."""
        nothing = pd.Series(dtype=float)
        column = column_of("rmse_speed", scope)
        if column not in self.pairs:
            return 0
        speeds = self.pairs.pivot_table(
            index="pair_id", columns="method", values=column, aggfunc="first"
        )
        before, after = speeds.get(baseline, nothing), speeds.get("policy", nothing)
        return int((np.isfinite(before) & np.isfinite(after) & (before > 0)).sum())

    @property
    def _style_result(self) -> StyleResult | None:
        """The scores; the weights of the indicators stand in no file."""
        table = self.tables.get("style")
        if table is None or not len(table):
            return None
        percentiles = self.setting("style.percentiles")
        if not isinstance(percentiles, list):
            percentiles = [25.0, 75.0]
        scores = table["score"].to_numpy(dtype=float)
        known = scores[np.isfinite(scores)]
        low, high = np.percentile(known, percentiles) if len(known) else (math.nan, math.nan)
        return StyleResult(table, {}, (float(low), float(high)))

    @cached_property
    def pair_trajectories(self) -> tuple[PairTrajectory, ...]:
        """The test parts of all pairs; empty if the job left none."""
        if "trajectories" not in self.tables:
            return ()
        found = []
        for pair_id, frames in self.tables["trajectories"].groupby("pair_id", sort=False):
            found.append(self._trajectory(str(pair_id), frames))
        return tuple(found)

    def _trajectory(self, pair_id: str, frames: pd.DataFrame) -> PairTrajectory:
        def column(name: str) -> np.ndarray:
            return frames[name].to_numpy(dtype=float)

        methods = [method for method in self.methods if f"speed_{method}" in frames]
        names = [axis.name for axis in self.parameters]
        parameters = {}
        for method in methods:
            chosen = frames.reindex(columns=[f"{name}_{method}" for name in names])
            parameters[method] = chosen.to_numpy(dtype=float)
        return PairTrajectory(
            pair_id=pair_id,
            driver="",
            time=column("time_s"),
            leader_speed=column("leader_speed"),
            real_speed=column("real_speed"),
            real_gap=column("real_gap"),
            speed={method: column(f"speed_{method}") for method in methods},
            gap={method: column(f"gap_{method}") for method in methods},
            parameters=parameters,
        )


def _number(value: object) -> float | None:
    return float(value) if isinstance(value, int | float) else None


_METRIC = TypeAdapter(MetricInfo)


def known_metrics(data: Mapping[str, Any], metrics: Mapping[str, float]) -> tuple[MetricInfo, ...]:
    """Returns the metrics of `data.json`, each with the scopes that `metrics.json` has some of."""
    listed = data.get("metrics")
    known = []
    for one in listed if isinstance(listed, list) else []:
        with suppress(ValidationError):  # what is no metric is none
            metric = _METRIC.validate_python(one)
            scopes = []
            for scope in metric.scopes:
                if any(key.startswith(key_of(metric.name, "", scope)) for key in metrics):
                    scopes.append(scope)
            if scopes and metric.summary in SUMMARIES:
                known.append(replace(metric, scopes=tuple(scopes)))
    return tuple(known)


def read_job(origin: Origin) -> Job:
    """Reads one finished job, from its folder and what is known besides.

    Raises:
        DataError: a file cannot be read, or is not what a job writes.
    """
    folder = origin.folder
    assert folder is not None
    examine(folder)
    config = read_yaml(folder / "config.yaml")
    data = optional(folder / "data.json", read_json) or {}
    tables = read_tables(folder)
    pairs = folder / "pairs.csv"
    if "pairs" not in tables:
        raise DataError(f"{pairs} is missing; run the job again, or leave it out")
    if not {"policy", "fixed"} & set(tables["pairs"]["method"]):
        raise DataError(f"{pairs} is damaged: it has no row of the method 'policy' or 'fixed'")
    missing = [one for one in installed() if one.part.always and one.name not in tables]
    hydra = folder if origin.hydra is None else origin.hydra
    typed = optional(hydra / ".hydra" / "overrides.yaml", read_yaml_list)
    started, seconds = _duration(hydra, origin)
    version, commit = str(origin.version or data.get("cfx") or ""), str(data.get("commit") or "")
    if commit:  # of the folder that the job was started in
        version = f"{version}, commit {commit}".removeprefix(", ")
    return Job(
        place=origin.place,
        config=public(config),
        data=public(data),
        metrics=read_metrics(folder / "metrics.json"),
        tables=tables,
        overrides=None if typed is None else tuple(without_passwords(str(one)) for one in typed),
        experiment=str(config.get("preset") or ""),
        started=started,
        seconds=seconds,
        version=version,
        missing=tuple(file_of(one) for one in missing),
    )


def _duration(folder: Path, origin: Origin) -> tuple[datetime | None, float | None]:
    """Returns when the job began, and how many seconds it took."""
    if origin.started is not None:
        return origin.started, origin.seconds
    stamps = []
    with suppress(OSError):
        for line in (folder / "cfx.log").read_text(encoding="utf-8", errors="replace").splitlines():
            with suppress(ValueError):  # each message begins with its time
                stamps.append(datetime.strptime(line[:19], "%Y-%m-%d %H:%M:%S"))
    seconds = (stamps[-1] - stamps[0]).total_seconds() if stamps else None
    status = optional(folder / "outcome.json", read_json) or {}
    if isinstance(status.get("seconds"), int | float):
        seconds = float(status["seconds"])
    return stamps[0] if stamps else None, seconds
