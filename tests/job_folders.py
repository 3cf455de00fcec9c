"""Folders as finished jobs leave them, of jobs that never ran."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

from cfx.core.parameters import ParameterSpace
from cfx.data.style import CLUSTERS
from cfx.evaluation.result import Evaluation, Purpose
from cfx.evaluation.statistics import Improvement, improvement_statistics
from cfx.evaluation.tables import values_of
from cfx.results.tables.history import history_metrics
from tests.made_up import GAINS, TWO, info, make_history, make_platoon, make_results, with_metric

WITHIN = ("default", "driver_specific", "policy")
ACROSS = ("default", "pooled", "driver_specific", "policy")


def write_job(
    folder: Path,
    *,
    model: str = "krauss",
    pairs: int = 8,
    frames: int = 40,
    methods: Sequence[str] = WITHIN,
    cluster: str = "all",
    experiment: str = "",
    overrides: Sequence[str] = (),
    seed: int = 0,
    space: ParameterSpace = TWO,
    source: str = "recording.parquet",
    settings: Mapping[str, Any] | None = None,
    purpose: Purpose = Purpose.ADAPTATION,
    further: bool = False,
) -> dict[str, float | None]:
    """Writes a job's folder; returns what its metrics.json holds.

    `further`: with safety, platoons and history.
    """
    made = make_results(
        pairs=pairs, frames=frames, space=space, seed=seed, epochs=12, methods=tuple(methods)
    )
    evaluation = _completed(made.evaluation, methods, cluster)
    folder.mkdir(parents=True)
    if further:
        evaluation = _with_further_results(evaluation)
        assert evaluation.platoon is not None
        evaluation.platoon.table.to_parquet(folder / "platoon.parquet", index=False)
        evaluation.tables["history"].to_parquet(folder / "history.parquet", index=False)
    config = {
        "preset": experiment or None,
        "data": {"name": "tidy", "path": source},
        "model": {
            "name": model,
            "parameters": {p.name: {"low": p.low, "high": p.high} for p in space.tuned},
        },
        "policy": {"name": "gru"},
        "optimizer": {"name": "random"},
        "learner": {"name": "imitation", "epochs": 12, "batch_size": 16},
        "protocol": {"name": "across_drivers", "folds": 5}
        if "pooled" in methods
        else {"name": "within_driver"},
        "seed": 0,
        "split": 0.8,
        "style": {"cluster": cluster, "percentiles": [25.0, 75.0]},
        "tracking": {"uri": "postgresql://someone:secret@host/db"},
        **(settings or {}),
    }
    (folder / "config.yaml").write_text(yaml.safe_dump(config, sort_keys=False), encoding="utf-8")
    evaluation.table.to_csv(folder / "pairs.csv", index=False)
    evaluation.values.to_parquet(folder / "pair_metrics.parquet", index=False)
    made.style.table.to_csv(folder / "style.csv", index=False)
    evaluation.trajectories_table().to_parquet(folder / "trajectories.parquet", index=False)
    made.curves.astype({"network": str}).to_parquet(folder / "curves.parquet", index=False)
    dropped = [{"reason": "shorter than 70 s", "count": 12, "unit": "pairs"}]
    units = [{"name": p.name, "unit": p.unit, "low": p.low, "high": p.high} for p in space.tuned]
    data = {
        "source": source,
        "fingerprint": "f",
        "pairs": pairs,
        "dropped": dropped,
        "parameters": units,
        "purpose": Purpose.CALIBRATION
        if config["policy"]["name"] in {"fixed", "default"}
        else purpose,
        "metrics": [metric.to_json() for metric in evaluation.measured],
    }
    (folder / "data.json").write_text(json.dumps(data), encoding="utf-8")
    (folder / ".hydra").mkdir()
    (folder / ".hydra" / "overrides.yaml").write_text(
        yaml.safe_dump(list(overrides)), encoding="utf-8"
    )
    (folder / "cfx.log").write_text(
        "2026-11-21 15:28:37,316 INFO begin\n2026-11-21 15:29:42,000 INFO end\n", encoding="utf-8"
    )
    found = evaluation.metrics()
    if evaluation.platoon is not None:
        found |= evaluation.platoon.metrics() | history_metrics(evaluation.tables["history"])
    metrics = {name: value if math.isfinite(value) else None for name, value in found.items()}
    (folder / "metrics.json").write_text(json.dumps(metrics), encoding="utf-8")
    return metrics


def _with_further_results(evaluation: Evaluation) -> Evaluation:
    methods = evaluation.methods
    further = {"hard_braking": 1.0, "jerk": 2.5, "at_bounds": 0.25}
    for metric, value in further.items():
        summary = "sum" if metric == "hard_braking" else "mean"
        by_method = dict.fromkeys(methods, value)
        if metric == "jerk":
            by_method["real"] = 0.4
        evaluation = with_metric(evaluation, metric, by_method, summary=summary)
    unseen = [method for method in methods if method != "driver_specific"]
    if "full_trajectory" in evaluation.improvements:
        for metric, value in {"collisions": 0.0, "hard_braking": 2.0}.items():
            by_method = dict.fromkeys(unseen, value)
            evaluation = with_metric(evaluation, metric, by_method, scope="full_trajectory")
    return dataclasses.replace(
        evaluation,
        platoon=make_platoon(dict.fromkeys(unseen, 2)),
        tables={"history": make_history(evaluation.trajectories, GAINS)},
    )


def _completed(evaluation: Evaluation, methods: Sequence[str], cluster: str) -> Evaluation:
    """Gives a made-up evaluation the clusters and statistics that a real one has."""
    about = evaluation.about.copy()
    if cluster == "all":
        about["cluster"] = [CLUSTERS[k] for k in about["cluster"]]
    else:
        about["cluster"] = cluster
    speeds = values_of(evaluation.values, "rmse_speed", "test")
    whole = "pooled" in methods
    improvements, improvements_whole = {}, {}
    for baseline in methods:
        if baseline == "policy":
            continue
        improvements[baseline] = _statistics(speeds[baseline], speeds["policy"])
        if whole and baseline != "driver_specific":
            improvements_whole[baseline] = _statistics(
                1.3 * speeds[baseline], 1.1 * speeds["policy"]
            )
    values, measured = evaluation.values, evaluation.measured
    if whole:
        values = pd.concat([values, _full_trajectory(values)], ignore_index=True)
        measured = (
            info("rmse_speed", "test", "full_trajectory"),
            info("rmse_gap", "test", "full_trajectory"),
            *measured[2:],
        )
    return dataclasses.replace(
        evaluation,
        about=about,
        values=values,
        measured=measured,
        improvements={"test": improvements, "full_trajectory": improvements_whole},
    )


def _full_trajectory(values: pd.DataFrame) -> pd.DataFrame:
    """Returns errors over full trajectories: somewhat larger; none of `driver_specific`."""
    factors = {"default": 1.3, "pooled": 1.3, "policy": 1.1}
    errors = values["metric"].isin(["rmse_speed", "rmse_gap"]) & values["method"].isin(factors)
    found = values[errors].assign(scope="full_trajectory")
    found["value"] *= found["method"].map(factors)
    return found


def _statistics(before: pd.Series[float], after: pd.Series[float]) -> Improvement:
    return improvement_statistics(before.to_numpy(), after.to_numpy())
