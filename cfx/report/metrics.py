"""What a job's files say of its metrics: names, units, meanings.

A metric of a plugin that is not installed here is known from `data.json` alone. Jobs of versions
that wrote nothing of the kind have the metrics that those versions measured.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from cfx.metrics.base import SCOPES, SUMMARIES, MetricInfo
from cfx.plots.words import FULL_TRAJECTORY, MINUS, TEST, pretty_unit


def _earlier(
    name: str,
    unit: str,
    direction: str,
    summary: str,
    heading: str,
    meaning: str,
    scopes: tuple[str, ...] = SCOPES,
) -> MetricInfo:
    return MetricInfo(
        name=name,
        unit=unit,
        direction=direction,
        summary=summary,
        heading=heading,
        meaning=meaning,
        scopes=scopes,
        headline=True,
        distribution="",
    )


_RMSE = "root mean square error"
_COUNTED = (TEST, FULL_TRAJECTORY)

EARLIER = (
    _earlier("rmse_speed", "m/s", "lower", "mean", "RMSE of speed", _RMSE),
    _earlier("rmse_gap", "m", "lower", "mean", "RMSE of gap", _RMSE),
    _earlier(
        "collisions",
        "pairs",
        "lower",
        "sum",
        "collisions",
        "pairs in which the simulated gap becomes negative",
        _COUNTED,
    ),
    _earlier(
        "hard_braking",
        "frames",
        "lower",
        "sum",
        "hard braking",
        f"frames with an acceleration below {MINUS}8 m/s²",
        _COUNTED,
    ),
    _earlier("jerk", "m/s3", "none", "mean", "jerk", "root mean square jerk"),
    _earlier(
        "at_bounds",
        "",
        "none",
        "mean",
        "at bounds",
        "share of the tuned parameters' values within 1 % of a bound",
    ),
)
"""What versions measured that wrote no list of metrics into `data.json`."""


def lists_metrics(data: Mapping[str, Any]) -> bool:
    """Says whether a job's `data.json` tells what was measured."""
    return isinstance(data.get("metrics"), list)


def known_metrics(data: Mapping[str, Any], metrics: Mapping[str, float]) -> tuple[MetricInfo, ...]:
    """Returns the metrics of a job, each with the scopes of which `metrics.json` has something.

    Args:
        data: what `data.json` holds.
        metrics: what `metrics.json` holds.
    """
    listed = list(EARLIER)
    if lists_metrics(data):
        listed = []
        for one in data["metrics"]:
            if isinstance(one, Mapping) and "name" in one:
                listed.append(_read(one))
    known = []
    for metric in listed:
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
    """Returns a metric as `data.json` describes it, whichever version wrote it."""
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
