"""Folders as finished jobs leave them, of jobs that never ran."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml

from cfx.evaluation.metrics import improvement_statistics
from cfx.evaluation.result import Evaluation, Improvement
from cfx.parameters import ParameterSpace
from cfx.style.result import CLUSTERS
from tests.made_up import GAINS, TWO, make_history, make_platoon, make_results

WITHIN = ("default", "fixed", "policy")
ACROSS = ("default", "population", "fixed", "policy")


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
    has_constant_baseline: bool = True,
    further: bool = False,
) -> dict[str, float | None]:
    """Writes a job's folder; returns what its metrics.json holds. `further`: with safety, platoons and history."""
    made = make_results(
        pairs=pairs, frames=frames, space=space, seed=seed, epochs=12, methods=tuple(methods)
    )
    evaluation = _completed(made.evaluation, methods, cluster)
    folder.mkdir(parents=True)
    if further:
        evaluation = _with_further_results(evaluation)
        assert evaluation.platoon is not None
        assert evaluation.history is not None
        evaluation.platoon.table.to_parquet(folder / "platoon.parquet", index=False)
        evaluation.history.to_parquet(folder / "history.parquet", index=False)
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
        if "population" in methods
        else {"name": "within_driver"},
        "seed": 0,
        "split": 0.8,
        "style": {"cluster": cluster, "percentiles": [25.0, 75.0]},
        "tracking": {"uri": "postgresql://someone:secret@host/db"},
        **(settings or {}),
    }
    (folder / "config.yaml").write_text(yaml.safe_dump(config, sort_keys=False), encoding="utf-8")
    evaluation.table.to_csv(folder / "pairs.csv", index=False)
    made.style.table.to_csv(folder / "style.csv", index=False)
    evaluation.trajectories_table().to_parquet(folder / "trajectories.parquet", index=False)
    made.curves.astype({"network": str}).to_parquet(folder / "curves.parquet", index=False)
    dropped = [{"reason": "fewer than 700 frames", "count": 12, "unit": "pairs"}]
    units = [{"name": p.name, "unit": p.unit, "low": p.low, "high": p.high} for p in space.tuned]
    data = {
        "source": source,
        "fingerprint": "f",
        "pairs": pairs,
        "dropped": dropped,
        "parameters": units,
        "has_constant_baseline": has_constant_baseline,
    }
    (folder / "data.json").write_text(json.dumps(data), encoding="utf-8")
    (folder / ".hydra").mkdir()
    (folder / ".hydra" / "overrides.yaml").write_text(
        yaml.safe_dump(list(overrides)), encoding="utf-8"
    )
    (folder / "cfx.log").write_text(
        "2026-11-21 15:28:37,316 INFO begin\n2026-11-21 15:29:42,000 INFO end\n", encoding="utf-8"
    )
    metrics = {
        name: value if math.isfinite(value) else None
        for name, value in evaluation.metrics().items()
    }
    (folder / "metrics.json").write_text(json.dumps(metrics), encoding="utf-8")
    return metrics


def _with_further_results(evaluation: Evaluation) -> Evaluation:
    table = evaluation.table.assign(hard_braking=1, rms_jerk=2.5, real_rms_jerk=0.4, at_bounds=0.25)
    if evaluation.full_trajectory_improvements:
        table = table.assign(full_trajectory_collisions=0.0, full_trajectory_hard_braking=2.0)
    methods = [method for method in evaluation.methods if method != "fixed"]
    platoon = make_platoon(dict.fromkeys(methods, 2))
    return dataclasses.replace(
        evaluation, table=table, platoon=platoon, history=make_history(evaluation.drives, GAINS)
    )


def _completed(evaluation: Evaluation, methods: Sequence[str], cluster: str) -> Evaluation:
    """Gives a made-up evaluation the columns and statistics that a real one has."""
    table = evaluation.table.copy()
    table["cluster"] = [CLUSTERS[k] for k in table["cluster"]] if cluster == "all" else cluster
    speeds = table.pivot_table(index="pair_id", columns="method", values="rmse_speed", sort=False)
    rmse = table["pair_id"].map
    whole = "population" in methods
    improvements, improvements_whole = {}, {}
    for baseline in (method for method in methods if method != "policy"):
        improvements[baseline] = _statistics(speeds[baseline], speeds["policy"])
        if baseline != "fixed":
            before = rmse(speeds[baseline]).astype(float)
            table[f"improvement_over_{baseline}"] = (before - table["rmse_speed"]) / before
            improvements_whole[baseline] = _statistics(
                1.3 * speeds[baseline], 1.1 * speeds["policy"]
            )
    if whole:
        factor = (
            table["method"]
            .map({"default": 1.3, "population": 1.3, "policy": 1.1, "fixed": np.nan})
            .astype(float)
        )
        table["full_trajectory_rmse_speed"], table["full_trajectory_rmse_gap"] = (
            factor * table["rmse_speed"],
            factor * table["rmse_gap"],
        )
    return Evaluation(
        table,
        improvements,
        evaluation.drives,
        evaluation.names,
        evaluation.units,
        evaluation.bounds,
        improvements_whole if whole else {},
    )


def _statistics(before: pd.Series[float], after: pd.Series[float]) -> Improvement:
    return improvement_statistics(before.to_numpy(), after.to_numpy(), seed=0)
