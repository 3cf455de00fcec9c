"""Which metrics a job measures: all that are installed, or those that `metrics` names."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, cast

from cfx.core import registry
from cfx.core.errors import PluginError
from cfx.evaluation.metrics.base import Metric

log = logging.getLogger(__name__)

ALWAYS = ("rmse_speed", "rmse_gap", "collisions")
"""Measured in every job: the comparison of methods, the figures and the reports rest on them."""

_TAKEN = re.compile(
    r"(steady|full_trajectory|real|improvement|parameter|rmse_improvement|platoon|history|labels)(_.*)?"
    r"|pair_id|recording|(leader|follower)_id|driver|cluster|style_score|fold|method|frames"
    r"|(train|validation)_loss|all"
)
"""Names of other columns of `pairs.csv` and of other metrics of a job."""


@dataclass(frozen=True)
class MeasuredMetric:
    """A metric that a job measures: its name, itself, and the distribution that brings it."""

    name: str
    metric: Metric
    distribution: str


@dataclass(frozen=True)
class LeftOut:
    """A plugin's metric that could not be measured, and why."""

    name: str
    distribution: str
    reason: str


@dataclass(frozen=True)
class MetricSet:
    """The metrics of a job in the order in which they are shown.

    Attributes:
        metrics: what is measured.
        left_out: what is installed and broken.
    """

    metrics: tuple[MeasuredMetric, ...]
    left_out: tuple[LeftOut, ...] = field(default=())

    @classmethod
    def of(cls, chosen: Literal["all"] | Sequence[str] = "all") -> MetricSet:
        """Makes the metrics that are chosen, and those that every job measures.

        Args:
            chosen: names, or all that are installed. Of all, a broken one of a plugin is left out
                with a warning.

        Raises:
            PluginError: there is no metric of a name, or one that is named is broken.
        """
        if chosen == "all":
            return _all()
        return cls(_ordered([_made(entry) for entry in entries_of(chosen)]))

    @classmethod
    def own(cls) -> MetricSet:
        """Makes cfx's own metrics."""
        entries = registry.entries("metric")
        return cls(_ordered([_made(one) for one in entries if one.distribution == registry.OWN]))


def entries_of(chosen: Literal["all"] | Sequence[str] = "all") -> tuple[registry.Entry, ...]:
    """Returns the entries of the metrics that a job measures; imports none.

    Raises:
        PluginError: there is no metric of a name.
    """
    if chosen == "all":
        return tuple(one for one in registry.entries("metric") if not registry.rivals(one))
    return tuple(registry.entry("metric", name) for name in sorted({*ALWAYS, *chosen}))


def leave_out(name: str, distribution: str, reason: str) -> LeftOut:
    """Returns a note of a broken metric, after one warning that names its distribution."""
    log.warning("The metric %s of the distribution %s is left out: %s", name, distribution, reason)
    return LeftOut(name, distribution, reason)


def _all() -> MetricSet:
    found, left_out = [], []
    for entry in entries_of("all"):
        try:
            found.append(_made(entry))
        except PluginError as error:
            if entry.distribution == registry.OWN:
                raise
            left_out.append(leave_out(entry.name, entry.distribution, str(error)))
    return MetricSet(_ordered(found), tuple(left_out))


def _made(entry: registry.Entry) -> MeasuredMetric:
    if not re.fullmatch(r"[a-z][a-z0-9_]*", entry.name) or _TAKEN.fullmatch(entry.name):
        raise PluginError(
            f"{entry}: a metric cannot be called '{entry.name}', which stands for something else in"
            " a job's results; its author must rename it (small letters, digits and _)"
        )
    metric = cast(Metric, registry.create("metric", {"name": entry.name}))
    return MeasuredMetric(entry.name, metric, entry.distribution)


def _ordered(metrics: Sequence[MeasuredMetric]) -> tuple[MeasuredMetric, ...]:
    return tuple(sorted(metrics, key=lambda one: (one.metric.order, one.name)))
