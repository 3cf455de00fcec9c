"""What a job's files say of its metrics: names, units, meanings.

A metric of a plugin that is not installed here is known from `data.json` alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from cfx.evaluation.metrics.base import SUMMARIES, MetricInfo
from cfx.report.figures.text import TEST, pretty_unit


def known_metrics(data: Mapping[str, Any], metrics: Mapping[str, float]) -> tuple[MetricInfo, ...]:
    """Returns the metrics of a job, each with the scopes of which `metrics.json` has something.

    Args:
        data: what `data.json` holds.
        metrics: what `metrics.json` holds.
    """
    listed = data.get("metrics")
    known = []
    for one in listed if isinstance(listed, list) else []:
        if not isinstance(one, Mapping) or "name" not in one:
            continue
        metric = _read(one)
        scopes = []
        for scope in metric.scopes:
            if _measured(metric.name, scope, metrics):
                scopes.append(scope)
        if scopes:
            known.append(replace(metric, scopes=tuple(scopes)))
    return tuple(known)


def metric_title(metric: MetricInfo) -> str:
    """Returns a heading with the unit: "RMSE speed (m/s)"."""
    heading = metric.heading[:1].upper() + metric.heading[1:]
    return f"{heading} ({pretty_unit(metric.unit)})" if metric.unit else heading


def _read(values: Mapping[str, Any]) -> MetricInfo:
    """Returns a metric as `data.json` describes it."""
    scopes = values.get("scopes")
    summary = str(values.get("summary", "mean"))
    return MetricInfo(
        name=str(values["name"]),
        unit=str(values.get("unit", "")),
        direction=str(values.get("direction", "none")),
        summary=summary if summary in SUMMARIES else "mean",
        heading=str(values.get("heading") or values["name"]),
        meaning=str(values.get("meaning", "")),
        scopes=tuple(map(str, scopes)) if isinstance(scopes, list) else (TEST,),
        headline=bool(values.get("headline", True)),
        distribution=str(values.get("distribution", "")),
    )


def _measured(name: str, scope: str, metrics: Mapping[str, float]) -> bool:
    prefix = f"{name}/" if scope == TEST else f"{scope}/{name}/"
    return any(key.startswith(prefix) for key in metrics)
