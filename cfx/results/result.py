"""A finished job: in memory what its folder holds.

One class serves whoever reads a job: tables and figures, the console, MLflow, reports and Python.
A metric of a plugin that is not installed here is known from `data.json` alone.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pandas as pd
from pydantic import TypeAdapter, ValidationError

from cfx.core import registry
from cfx.core.files import atomic_write, write_json
from cfx.core.guest import default_torch, guest, in_turn
from cfx.data.style import StyleResult
from cfx.data.tidy import write_tidy
from cfx.errors import DataError, listed
from cfx.evaluation.headline import headline, improvement_key
from cfx.evaluation.metrics.base import RMSE_SPEED, SUMMARIES, MetricInfo, column_of, key_of
from cfx.evaluation.result import METHODS, Evaluation, PairTrajectory, Purpose
from cfx.evaluation.statistics import STATISTICS, Improvement, are_comparable
from cfx.evaluation.tables import scope_label
from cfx.figures.drawing import as_html, drawn, remove_figures, write_figures
from cfx.figures.wording import short_label
from cfx.policies import checkpoint
from cfx.results.config import JobConfig
from cfx.results.folder import DATA, METRICS, begin, write_config, writing
from cfx.results.provenance import distributions
from cfx.results.table import ResultTable, tables_of
from cfx.simulation.trajectory import TRANSIENT_S

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from cfx.core.parameters import Parameter
    from cfx.evaluation.demo import Demo
    from cfx.policies.agent import Agent

log = logging.getLogger(__name__)

OUTSIDE = "outside_range"
"""A metric that says nothing of constant parameters."""

_TEST = "test"


@dataclass(frozen=True)
class ParameterAxis:
    """A tuned parameter: name, unit, bounds within which policies choose, and what it is."""

    name: str
    unit: str = ""
    low: float | None = None
    high: float | None = None
    meaning: str = ""


@dataclass(frozen=True, repr=False, eq=False)
class Result:
    """A finished job; `cfx.load` reads it back from the job's folder.

    Life cycle: a job makes one when its protocol has run (`of`), and writes it; each step returns
    it with more. Then it is tracked.

    Attributes:
        config: the resolved configuration, as `config.yaml` holds it.
        data: where the pairs came from, what was left out and what was measured, as `data.json`
            holds it.
        metrics: under their MLflow names; NaN where a metric is not defined.
        tables: by name (`cfx.results.table`); `pairs` is there.
        folder: the job's output folder; None if nothing was written (`save` does).
        figures: the figures' files.
        demo: the files of its demonstration.
        run_id: MLflow's id of the run; "" if it was not tracked.
        place: what people know it by: its folder, its address, or its MLflow run.
        overrides: what was typed; None if that is not known.
        started: when it began; None if that is not known.
        seconds: how long it took, s; None if that is not known.
        version: of cfx; "" if that is not known.
        missing: files that every job has and this one has not.
        name: what tells it from the others of one report.
        measured: what the protocol measured; None if the job was read back: it is in the tables.
        trained: its policy; None: it is in the folder, and `policy` reads it.
    """

    config: Mapping[str, Any] = field(default_factory=dict)
    data: Mapping[str, Any] = field(default_factory=dict)
    metrics: Mapping[str, float] = field(default_factory=dict)
    tables: Mapping[str, pd.DataFrame] = field(default_factory=dict)
    folder: Path | None = None
    figures: tuple[Path, ...] = ()
    demo: tuple[Path, ...] = ()
    run_id: str = ""
    place: str = ""
    overrides: tuple[str, ...] | None = None
    started: datetime | None = None
    seconds: float | None = None
    version: str = ""
    missing: tuple[str, ...] = ()
    name: str = ""
    measured: Evaluation | None = None
    trained: Agent | None = None

    @classmethod
    def of(
        cls,
        evaluation: Evaluation,
        *,
        config: Mapping[str, Any] | None = None,
        data: Mapping[str, Any] | None = None,
        tables: Mapping[str, pd.DataFrame] | None = None,
        metrics: Mapping[str, float] | None = None,
        trained: Agent | None = None,
    ) -> Result:
        """Returns the result of an evaluation, of which nothing is written yet.

        Args:
            evaluation: what was measured.
            config: as in the attributes; None: not known.
            data: what `data.json` says besides what the evaluation itself says.
            tables: further ones than those that the evaluation holds.
            metrics: None: those of the evaluation alone.
            trained: the policy that drove.
        """
        measured = {"pairs": evaluation.table, **evaluation.tables}
        if evaluation.style is not None:
            measured["style"] = evaluation.style.table
        return cls(
            config=config or {},
            data={**(data or {}), **description_of(evaluation)},
            metrics=evaluation.metrics() if metrics is None else metrics,
            tables={**measured, **(tables or {})},
            measured=evaluation,
            trained=trained,
        )

    # What it consists of

    def setting(self, path: str) -> Any:
        """Returns a setting such as "style.cluster"; None if the job has none of that name."""
        value: Any = self.config
        for key in path.split("."):
            value = value.get(key) if isinstance(value, Mapping) else None
        return value

    def component(self, group: str) -> str:
        """Returns the name of a component, of the group "model" for instance "w99".

        It is "" for the learner of a job that trains nothing, whatever its configuration says.
        """
        if group == "learner" and self.setting("protocol.run"):
            return ""
        return str(self.setting(f"{group}.name") or "")

    @property
    def seed(self) -> int:
        """For everything random; 0 where the configuration is not known."""
        return int(self.config.get("seed", 0))

    @property
    def split(self) -> float:
        """Share of each pair that was calibrated on; NaN if that is not known."""
        split = self.config.get("split")
        return float(split) if isinstance(split, int | float) else math.nan

    @cached_property
    def policy(self) -> Agent:
        """The policy of the job, ready for another trajectory.

        Raises:
            DataError: it cannot be read from the job's folder.
        """
        if self.trained is not None:
            return self.trained
        if self.folder is None:
            raise DataError("this result has no policy: it was made without one")
        return checkpoint.load_agent(self.folder / "policy")

    @property
    def evaluation(self) -> Evaluation:
        """What the protocol measured, in this process.

        Raises:
            DataError: the job was read back; what was measured is in its tables and metrics.
        """
        if self.measured is None:
            raise DataError(
                "a job that was read back has no evaluation: take its tables and metrics"
            )
        return self.measured

    @property
    def pairs(self) -> pd.DataFrame:
        """A row per pair and method; SI units; `cluster` by name. Empty if nothing was tested."""
        return self.tables["pairs"] if "pairs" in self.tables else pd.DataFrame()

    @cached_property
    def trajectories(self) -> Sequence[PairTrajectory]:
        """The test parts of all pairs; empty if the job left none."""
        if self.measured is not None:
            return self.measured.trajectories
        if "trajectories" not in self.tables:
            return ()
        names = [parameter.name for parameter in self.parameters]
        trajectories = []
        for pair_id, frames in self.tables["trajectories"].groupby("pair_id", sort=False):
            trajectories.append(_trajectory(str(pair_id), frames, self.methods, names))
        return tuple(trajectories)

    @property
    def parameters(self) -> tuple[ParameterAxis, ...]:
        """The tuned parameters, within the bounds in which the policy chooses."""
        axes = []
        for about in self.data.get("parameters") or ():
            low, high = _number(about.get("low")), _number(about.get("high"))
            unit, meaning = str(about.get("unit", "")), str(about.get("meaning", ""))
            axes.append(ParameterAxis(str(about.get("name")), unit, low, high, meaning))
        return tuple(axes)

    @property
    def style(self) -> StyleResult | None:
        """The driving style of each driver; None if it is not known."""
        if "style" not in self.tables or not len(self.tables["style"]):
            return None
        about = self.data.get("style") or {}
        low, high = about.get("cuts") or (math.nan, math.nan)
        return StyleResult(self.tables["style"], about.get("weights") or {}, (low, high))

    @property
    def transient_s(self) -> float:
        """Length of the transient at the beginning of the test part, s."""
        return float(self.data.get("transient_s", TRANSIENT_S))

    @property
    def outside(self) -> dict[str, str]:
        """How much the policy drove outside what it has learned from, in words by scope."""
        return dict(self.data.get("outside") or {})

    @property
    def pooled_over(self) -> str:
        """Whose parameters the method `pooled` has: "4 other folds"; "" if that is not known."""
        protocol = self.data.get("protocol")
        over = protocol.get("pooled_over") if isinstance(protocol, Mapping) else None
        return str(over or "")

    def method_label(self, method: str) -> str:
        """Returns how a table names a method: pooled over whom, shrunk towards what."""
        label = short_label(method)
        if method == "pooled" and self.pooled_over:
            label += f" over {self.pooled_over}"
        if method == "shrunk":
            label += " towards the default"
        return label

    def scope_label(self, scope: str) -> str:
        """Returns how a part of the trajectories is named."""
        return scope_label(scope, self.transient_s)

    # Which methods are compared

    @property
    def purpose(self) -> Purpose:
        """What its numbers say."""
        purpose = self.data.get("purpose")
        return Purpose(purpose) if purpose in set(Purpose) else Purpose.ADAPTATION

    @property
    def methods(self) -> tuple[str, ...]:
        """The methods that were compared, in the order in which they are shown."""
        if "method" not in self.pairs:
            return ()
        compared = self.pairs["method"].astype(str).unique().tolist()
        methods = []
        for method in dict.fromkeys((*METHODS, *compared)):  # cfx's own first, each once
            if method in compared:
                methods.append(method)
        return tuple(methods)

    @property
    def shown_methods(self) -> tuple[str, ...]:
        """The methods whose numbers say something of their own.

        Without a constant baseline that is only the policy; a calibration's policy is one of its
        constant sets once more.
        """
        if self.purpose is Purpose.POLICY:
            return ("policy",)
        constant = [method for method in self.methods if method != "policy"]
        if self.purpose is Purpose.CALIBRATION and constant:
            return tuple(constant)
        return self.methods

    @property
    def judged(self) -> str:
        """The method whose numbers the job is judged by: the policy; of a calibration its own.

        That is driver-specific parameters, or pooled ones where there are no others.
        """
        for method in ("policy", "driver_specific", "pooled"):
            if method in self.shown_methods:
                return method
        return "default"

    @cached_property
    def judge(self) -> MetricInfo:
        """The error by which methods, and jobs, are compared: what was minimised."""
        return judge_of(self.data, self.metrics)

    def baselines(self, scope: str = _TEST) -> tuple[str, ...]:
        """Returns what the policy was compared with, driver-specific calibration first.

        It is empty if the job has another purpose.
        """
        if self.purpose is not Purpose.ADAPTATION:
            return ()
        baselines: list[str] = []
        for method in ("driver_specific", *self.methods):
            was_compared = (
                f"{improvement_key(self.judge.name, method, scope)}/geometric" in self.metrics
            )
            is_new = method not in {*baselines, "policy"}
            if was_compared and is_new and method in self.methods:
                baselines.append(method)
        return tuple(baselines)

    # Numbers

    def metric(self, name: str, method: str, scope: str = _TEST) -> float:
        """Returns a metric of a method over a part of the trajectories; NaN if it is not known."""
        key = key_of(name, method, scope)
        if key in self.metrics:
            return self.metrics[key]
        return self._summaries.get((name, method, scope), math.nan)

    def has_metric(self, name: str, method: str, scope: str = _TEST) -> bool:
        """Says whether a metric was measured, for the policy or for one of `shown_methods`."""
        is_shown = method in (*self.shown_methods, "policy")
        return is_shown and key_of(name, method, scope) in self.metrics

    @cached_property
    def known_metrics(self) -> tuple[MetricInfo, ...]:
        """What the job measured, in the order in which it is shown."""
        metrics = []
        for metric in known_metrics(self.data, self.metrics):
            if metric.name != OUTSIDE or self.purpose is not Purpose.CALIBRATION:
                metrics.append(metric)
        return tuple(metrics)

    @cached_property
    def _summaries(self) -> dict[tuple[str, str, str], float]:
        """Metrics by name, method and scope, summarised from the values of the pairs."""
        summaries: dict[tuple[str, str, str], float] = {}
        if "pair_metrics" not in self.tables:
            return summaries
        how = {metric.name: metric.summary for metric in self.known_metrics}
        for key, rows in self.tables["pair_metrics"].groupby(["metric", "method", "scope"]):
            name, method, scope = map(str, key)
            summary = rows["value"].dropna().agg(how.get(name, "mean"))
            summaries[name, method, scope] = float(summary)
        return summaries

    def improvement(self, over: str = "driver_specific", scope: str = _TEST) -> pd.Series:
        """Returns the policy's improvement over a baseline (0.1 is 10 %), of the error `judge`.

        Args:
            over: the baseline: `driver_specific`, `pooled` or `default`.
            scope: `test`; `steady`, after its first seconds; or `full_trajectory`.

        Returns:
            geometric, ci95_low, ci95_high, ratio_of_means, median, win_rate, p_value, mean_ratio,
            trimmed_mean_ratio, drivers; see `cfx.evaluation.statistics.Improvement`.

        Raises:
            DataError: they were not compared.
        """
        prefix = improvement_key(self.judge.name, over, scope)
        if f"{prefix}/geometric" not in self.metrics:
            compared = []
            for method in METHODS:
                if f"{improvement_key(self.judge.name, method, scope)}/geometric" in self.metrics:
                    compared.append(method)
            raise DataError(
                f"improvement(over={over!r}, scope={scope!r}): the policy was not compared with it;"
                f" known there: {listed(compared) or 'nothing'}"
            )
        values = {name: self.metrics.get(f"{prefix}/{name}") for name in STATISTICS}
        return pd.Series(values, dtype=float, name=f"improvement over {over}")

    def statistics(self, baseline: str, scope: str = _TEST) -> Improvement:
        """Returns the improvement over a baseline; NaN where a statistic is not known."""
        prefix = improvement_key(self.judge.name, baseline, scope)
        statistics: dict[str, float] = {}
        for name in STATISTICS:
            if name != "drivers":
                statistics[name] = self.metrics.get(f"{prefix}/{name}", math.nan)
        drivers = self._improved_drivers(baseline, scope)
        undefined = self.pairs["pair_id"].nunique() - len(drivers) if len(self.pairs) else 0
        return Improvement(
            **statistics, pairs=len(drivers), undefined=undefined, drivers=drivers.nunique()
        )

    def _improved_drivers(self, baseline: str, scope: str) -> pd.Series:
        """Returns the drivers of the pairs whose improvement over a baseline is defined."""
        column = column_of(self.judge.name, scope)
        if column not in self.pairs:
            return pd.Series(dtype=object)
        rows = self.pairs.drop_duplicates(["pair_id", "method"])
        errors = rows.pivot_table(index="pair_id", columns="method", values=column, dropna=False)
        if baseline not in errors or "policy" not in errors:
            return pd.Series(dtype=object)
        before, after = errors[baseline], errors["policy"]
        is_defined = are_comparable(before.to_numpy(float), after.to_numpy(float))
        drivers = rows.drop_duplicates("pair_id").set_index("pair_id")["driver"]
        return drivers[drivers.index.isin(errors.index[is_defined])]

    @property
    def improvements(self) -> dict[str, Improvement]:
        """Statistics of the policy's improvement on the test part, by baseline."""
        return {baseline: self.statistics(baseline) for baseline in self.baselines()}

    def errors_by(self, metric: str) -> pd.DataFrame:
        """Returns a row per pair, by the method that the job is judged by.

        Args:
            metric: name of the error, such as that of `judge`.

        Returns:
            `pair_id`, `driver`, `frames` that count, and `error` on the test part, in its unit.
        """
        rows = self.pairs[self.pairs["method"] == self.judged]
        columns = ["pair_id", "driver", "frames", metric]
        return rows[columns].rename(columns={metric: "error"})

    @cached_property
    def by_pair(self) -> pd.DataFrame:
        """A row per pair.

        Columns: pair_id, driver, cluster, style_score, `rmse_speed/METHOD`, `rmse_gap/METHOD`, the
        error by which the job is judged where it is another, and its `improvement/BASELINE`.
        """
        first = self.pairs.drop_duplicates("pair_id").set_index("pair_id")
        table = first.filter(items=["driver", "cluster", "style_score"])
        for method in self.methods:
            rows = self.pairs[self.pairs["method"] == method]
            of_method = rows.drop_duplicates("pair_id").set_index("pair_id")
            for column in dict.fromkeys((self.judge.name, "rmse_speed", "rmse_gap")):
                table[f"{column}/{method}"] = of_method[column]
        rows = self.pairs[self.pairs["method"] == "policy"]
        of_policy = rows.drop_duplicates("pair_id").set_index("pair_id")
        for baseline in self.methods:
            column = f"improvement_over_{baseline}"
            if column in of_policy:
                table[f"improvement/{baseline}"] = of_policy[column]
        return table.reset_index()

    # From Python

    def plot(self, name: str = "improvement_per_driver") -> Figure:
        """Draws one of the job's figures.

        Args:
            name: as their files are called: `drives`, `error_over_time`, `chosen_parameters`, ...

        Raises:
            DataError: there is no such figure, or the job has nothing of what it shows.
        """
        return drawn(name, self)

    def save(self, folder: str | Path) -> Result:
        """Writes the job's folder, as a job of the command line does; MLflow is not told.

        Args:
            folder: made if it is not there.

        Returns:
            The same result, with its folder and figures.

        Raises:
            DataError: the job was read back from a folder, which can be copied.
            OutputError: it cannot be written.
        """
        if self.measured is None:
            raise DataError(f"this job was read from {self.folder}; copy that folder")
        config = JobConfig.of(self.config)
        with in_turn(), guest(), default_torch():
            begin(Path(folder), config)
            return self.write(Path(folder), config)

    def with_tables(self, config: JobConfig) -> Result:
        """Returns it with all tables and metrics that a configuration asks for; writes nothing."""
        tables, metrics = tables_of(self.evaluation, _chosen_by(config))
        return replace(self, tables=tables, metrics={**self.metrics, **metrics})

    def write(
        self, folder: Path, config: JobConfig, tell: Callable[[Result], None] | None = None
    ) -> Result:
        """Writes all that a job leaves behind.

        Args:
            folder: of the job; `begin` has made it.
            config: the job's configuration.
            tell: is told the tables and metrics before figures are drawn, which takes seconds.

        Raises:
            CfxError: a demonstration cannot be shown, or a file cannot be written.
        """
        evaluation = self.evaluation
        with writing(folder):
            (folder / METRICS).unlink(missing_ok=True)
            write_config(folder, config)
            tables, metrics = tables_of(evaluation, _chosen_by(config), folder)
            pairs = evaluation.recorded
            if pairs is not None and any(pair.truth for pair in pairs):
                with atomic_write(folder / "data.parquet") as temporary:
                    write_tidy(pairs, temporary)
            result = replace(
                self,
                folder=folder,
                place=str(folder),
                tables=tables,
                metrics={**self.metrics, **metrics},
            )
            if tell is not None:
                tell(result)
            checkpoint.save_agent(self.policy, folder / "policy")
            figures = _write_figures(folder / "figures", result, config)
            result = replace(result, figures=tuple(figures), demo=self._write_demo(folder, config))
            write_json(folder / DATA, dict(result.data))
            written: dict[str, float | None] = {}
            for name, value in result.metrics.items():
                written[name] = value if math.isfinite(value) else None
            write_json(folder / METRICS, written)
        return result

    def _write_demo(self, folder: Path, config: JobConfig) -> tuple[Path, ...]:
        """Writes the demonstration into its folder within the job's; returns its files."""
        if config.demo is None:
            return ()
        pairs = self.evaluation.recorded
        assert pairs is not None
        demo = cast("Demo", registry.create("demo", config.demo))
        demo_folder = folder / config.demo["name"]
        demo_folder.mkdir(parents=True, exist_ok=True)
        return tuple(demo.write(demo_folder, pairs, self.policy, self.evaluation, config.protocol))

    def __repr__(self) -> str:
        """Returns two lines for people: what it is and how well it drives, and where it lies."""
        model, policy = self.component("model"), self.component("policy")
        if not model:  # of a ready-made policy the folder holds no configuration
            model = str(self.policy.model_node["name"])
            policy = str(self.policy.policy_node["name"])
        chosen = [f"model={model}", f"policy={policy}"]
        if len(self.pairs):
            chosen.append(f"{self.pairs['pair_id'].nunique()} pairs")
        _, words = headline(self.metrics, self.judge)
        if words:
            chosen.append(words)
        folder = "not saved" if self.folder is None else f"folder={str(self.folder)!r}"
        return f"Result({', '.join(chosen)},\n  {folder})"

    def _repr_html_(self) -> str:
        rows = {}
        for method in self.methods:
            of_method = self.pairs[self.pairs["method"] == method]
            columns = list(dict.fromkeys((self.judge.name, "rmse_speed", "rmse_gap")))
            rows[method] = of_method[columns].mean()
        return as_html(repr(self), pd.DataFrame(rows).T.rename_axis("mean over pairs"))


def _chosen_by(config: JobConfig) -> tuple[registry.Installed[ResultTable], ...]:
    """Returns the tables that a configuration asks for."""
    return registry.chosen("table", config.tables, distributions(config.model_dump()))


def described_parameters(parameters: Iterable[Parameter]) -> list[dict[str, Any]]:
    """Returns what `data.json` says of a model's tuned parameters."""
    described = []
    for parameter in parameters:
        described.append(
            {
                "name": parameter.name,
                "unit": parameter.unit,
                "meaning": parameter.meaning,
                "low": parameter.low,
                "high": parameter.high,
            }
        )
    return described


def description_of(evaluation: Evaluation) -> dict[str, Any]:
    """Returns what `data.json` says of an evaluation, so that a reader of the folder knows it."""
    style = evaluation.style
    described_style = None
    if style is not None:
        described_style = {"weights": dict(style.weights), "cuts": list(style.cuts)}
    return {
        "parameters": described_parameters(evaluation.parameters),
        "purpose": evaluation.purpose,
        "judge": evaluation.judge,
        "transient_s": TRANSIENT_S,
        "style": described_style,
        "metrics": [metric.to_json() for metric in evaluation.measured],
        "outside": dict(evaluation.outside),
        "metrics_left_out": [asdict(metric) for metric in evaluation.left_out],
    }


_METRIC = TypeAdapter(MetricInfo)


def known_metrics(data: Mapping[str, Any], metrics: Mapping[str, float]) -> tuple[MetricInfo, ...]:
    """Returns the metrics of `data.json`, each with the scopes that `metrics.json` has some of."""
    declared = data.get("metrics")
    infos = []
    for values in declared if isinstance(declared, list) else []:
        with suppress(ValidationError):  # another version, or somebody's edit, left it out
            metric = _METRIC.validate_python(values)
            scopes = _measured_scopes(metric, metrics)
            if scopes and metric.summary in SUMMARIES:
                infos.append(replace(metric, scopes=scopes))
    return tuple(infos)


def _measured_scopes(metric: MetricInfo, metrics: Mapping[str, float]) -> tuple[str, ...]:
    """Returns the scopes of a metric in which `metrics` has it, of whichever method."""
    scopes = []
    for scope in metric.scopes:
        prefix = key_of(metric.name, "", scope)
        if any(key.startswith(prefix) for key in metrics):
            scopes.append(scope)
    return tuple(scopes)


def judge_of(data: Mapping[str, Any], metrics: Mapping[str, float]) -> MetricInfo:
    """Returns the error by which a job is judged, from its `data.json` and `metrics.json`."""
    for metric in known_metrics(data, metrics):
        if metric.name == data.get("judge"):
            return metric
    return RMSE_SPEED


def _number(value: object) -> float | None:
    return float(value) if isinstance(value, int | float) else None


def _trajectory(
    pair_id: str, frames: pd.DataFrame, methods: Sequence[str], names: Sequence[str]
) -> PairTrajectory:
    """Returns one pair of the table of trajectories, with the tuned parameters of these names."""

    def column(name: str) -> np.ndarray:
        return frames[name].to_numpy(dtype=float)

    speed, gap, parameters = {}, {}, {}
    for method in methods:
        if f"speed_{method}" in frames:
            speed[method], gap[method] = column(f"speed_{method}"), column(f"gap_{method}")
            chosen = frames.reindex(columns=[f"{name}_{method}" for name in names])
            parameters[method] = chosen.to_numpy(dtype=float)
    return PairTrajectory(
        pair_id=pair_id,
        driver="",
        time=column("time_s"),
        leader_speed=column("leader_speed"),
        real_speed=column("real_speed"),
        real_gap=column("real_gap"),
        speed=speed,
        gap=gap,
        parameters=parameters,
    )


def _write_figures(folder: Path, result: Result, config: JobConfig) -> list[Path]:
    """Draws the figures that a configuration names, and says which others are installed."""
    remove_figures(folder)
    figures = []
    for figure in registry.chosen("figure", config.figures, distributions(config.model_dump())):
        is_named = config.figures == "all" or figure.name in config.figures
        if is_named or figure.attempt(lambda component: component.is_usual(result), False):
            figures.append(figure)
    paths = write_figures(folder, result, figures, formats=config.figure_formats)
    not_drawn = dict.fromkeys(figure.name for figure in registry.installed("figure"))
    for figure in figures:
        not_drawn.pop(figure.name, None)
    if not_drawn and config.figures != "none":
        words = "Not drawn (cfx figures JOB, figures=all or figures=[own,NAME] draw them): %s"
        log.info(words, ", ".join(not_drawn), extra={"file_only": True})
    return paths
