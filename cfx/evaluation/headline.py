"""A job's headline: one number and what it is, the same wherever a job is named."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import NamedTuple

from cfx.evaluation.metrics.base import RMSE_SPEED, MetricInfo, key_of

__all__ = [
    "interval_in_words",
    "summaries_disagree",
]
"""What plugins may use, as `cfx.plugin.headline`."""


RESULT = "result"
"""The tag that says it in words."""

ERROR = "error"
"""The tag with the name of the metric that a job is judged by, with its unit."""

DEFAULT_ERROR = "rmse_speed_mps"
"""What `ERROR` says of a job whose objective is not known."""

TESTED = "tested on"
"""The tag that two jobs share that were tested on the same frames of the same pairs."""

PERCENT = "improvement_percent"
"""What charts begin with. No metric of the headline has a group: MLflow puts such first."""

ERRORS = {"rmse_speed": ("RMSE of speed", "m/s"), "rmse_gap": ("RMSE of gap", "m")}
"""Heading and unit of the errors that a job tells beside the one that it is judged by."""

_COUNTED = ("collisions", "hard_braking")
"""Further metrics of the method that a job is judged by."""

_CONSTANT = {"driver_specific": "driver-specific", "pooled": "pooled", "default": "default"}
"""Constant parameters, the first of which is a calibration's number."""


def improvement_key(metric: str, baseline: str, scope: str = "test") -> str:
    """Returns how the metrics of a metric's improvement over a baseline begin."""
    return key_of(f"improvement/{metric}", baseline, scope)


def with_unit(metric: str, unit: str) -> str:
    """Returns how MLflow names a metric: `rmse_speed_mps`."""
    return f"{metric}_{unit.replace('/', 'p')}" if unit else metric


class Comparison(NamedTuple):
    """What the policy is compared with: a baseline over a part of the trajectories, by a metric."""

    metric: str
    baseline: str
    scope: str

    @property
    def key(self) -> str:
        """How the metrics of the improvement begin."""
        return improvement_key(self.metric, self.baseline, self.scope)


_COMPARISONS = (
    ("driver_specific", "test"),
    ("pooled", "full_trajectory"),
    ("pooled", "test"),
)
"""The first that was measured counts."""


def main_comparison(metrics: Mapping[str, float], judge: str) -> Comparison | None:
    """Returns the comparison that counts: over driver-specific parameters on the test part.

    Where there are none it is over pooled ones, on full trajectories; None if there is nothing.

    Args:
        metrics: the job's.
        judge: the metric by which the job is judged.
    """
    for baseline, scope in _COMPARISONS:
        compared = Comparison(judge, baseline, scope)
        if math.isfinite(metrics.get(f"{compared.key}/geometric", math.nan)):
            return compared
    return None


def lower_by(before: float, after: float) -> float:
    """Returns by what share an error is lower than one before; NaN where that is not known."""
    return (before - after) / before if before > 0 else math.nan


_CLOSE = 0.03
"""Two summaries of an improvement that differ by no more, and not in sign, say the same."""


def summaries_disagree(geometric: float, ratio_of_means: float) -> str:
    """Returns the ratio of mean errors in words, where it disagrees with the improvement; or "".

    Each driver counts alike in a geometric mean. Drivers with large errors outweigh the others in a
    ratio of mean errors.
    """
    if not math.isfinite(geometric) or not math.isfinite(ratio_of_means):
        return ""
    if geometric * ratio_of_means >= 0 and abs(geometric - ratio_of_means) <= _CLOSE:
        return ""
    return f"of the mean errors {100 * ratio_of_means:+.1f} %"


_FARTHEST_END = -10.0
"""Improvement below which an interval's end is told as no more than that."""

FEW_DRIVERS = 10
"""Of fewer drivers than these an improvement says little about others."""


def doubts(statistics: Mapping[str, float]) -> list[str]:
    """Returns reasons to doubt an improvement: other mean errors, few drivers.

    Args:
        statistics: of the improvement, by name: those that are known.
    """
    ratio_of_means = statistics.get("ratio_of_means", math.nan)
    note = summaries_disagree(statistics.get("geometric", math.nan), ratio_of_means)
    parts = [note] if note else []
    drivers = statistics.get("drivers", math.nan)
    if drivers < FEW_DRIVERS:
        parts.append("one driver" if drivers == 1 else f"{drivers:.0f} drivers")
    return parts


def main_error(metrics: Mapping[str, float], judge: str) -> float:
    """Returns the error that a job is judged by: the policy's; of a calibration driver-specific.

    Args:
        metrics: the job's.
        judge: the metric by which the job is judged.
    """
    for method in ("policy", *_CONSTANT):
        error = metrics.get(key_of(judge, method), math.nan)
        if math.isfinite(error):
            return error
    return math.nan


def headline(
    metrics: Mapping[str, float], judge: MetricInfo = RMSE_SPEED
) -> tuple[dict[str, float], str]:
    """Returns a job's headline.

    A job without a method `policy` is a calibration. Beside the errors of the policy and of what it
    is compared with stand those of constant sets that err less than the latter: a policy that is
    better than a bad baseline is not good yet.

    Args:
        metrics: the job's, under their names in MLflow.
        judge: the error by which the job is judged.

    Returns:
        Metrics, rounded; and the result in words.
    """
    compared = main_comparison(metrics, judge.name)
    values: dict[str, float] = {}
    words = []
    if compared is not None:
        words.append(_improvement(metrics, compared, values))
    errors = {judge.name: (judge.heading, judge.unit), **ERRORS}
    baseline = "" if compared is None else compared.baseline
    for name, (heading, unit) in errors.items():
        measured = {}
        for method in ("policy", *_CONSTANT):
            error = metrics.get(key_of(name, method), math.nan)
            if math.isfinite(error):
                measured[method] = error
        if not measured:
            continue
        key = with_unit(name, unit)
        values[key] = round(next(iter(measured.values())), 3)
        if name == judge.name:
            for method, error in measured.items():
                if method != "policy":
                    values[with_unit(f"{name}_{method}", unit)] = round(error, 3)
        words.append(_error_said(f"{heading}", f" {unit}".rstrip(), measured, baseline))
    for name in _COUNTED:
        value = metrics.get(key_of(name, judged_method(metrics, judge.name)), math.nan)
        if math.isfinite(value):
            values[name] = round(value, 3)
    return values, "; ".join(words)


def judged_method(metrics: Mapping[str, float], judge: str) -> str:
    """Returns the method that a job is judged by, "" if none was measured."""
    for method in ("policy", *_CONSTANT):
        if math.isfinite(metrics.get(key_of(judge, method), math.nan)):
            return method
    return ""


def _error_said(heading: str, unit: str, measured: Mapping[str, float], baseline: str) -> str:
    """Returns an error in words: the policy's beside its baseline's, or that of constant sets."""
    if "policy" in measured:
        text = f"{heading} {measured['policy']:.3f}{unit}"
        if baseline in measured:
            beside = [baseline]
            for method in _CONSTANT:
                if measured.get(method, math.inf) < measured[baseline]:
                    beside.append(method)
            text += f" ({_constant_sets(measured, beside, unit)})"
        return text
    return f"{heading} {_constant_sets(measured, measured, unit)}"


def _constant_sets(measured: Mapping[str, float], methods: Iterable[str], unit: str) -> str:
    """Returns the errors of sets of constant parameters in words."""
    errors = []
    for method in methods:
        errors.append(f"{_CONSTANT[method]} {measured[method]:.3f}{unit}")
    return ", ".join(errors)


def fitted_errors(errors: Mapping[str, float]) -> dict[str, float]:
    """Returns the headline's errors on the part that was calibrated on.

    Args:
        errors: means of driver-specific parameters there, by metric.
    """
    fitted = {}
    for metric, (_, unit) in ERRORS.items():
        if math.isfinite(errors.get(metric, math.nan)):
            fitted[with_unit(f"{metric}_fitted", unit)] = round(errors[metric], 3)
    return fitted


def interval_in_words(low: float, high: float, unit: str = "") -> str:
    """Returns an improvement's interval in percent, or "one driver" where there is none.

    That of two or three drivers may begin anywhere: "below -1000" is all that is said of it.
    """
    if not math.isfinite(low):
        return "one driver"
    ends = []
    for end in (low, high):
        percent = f"{100 * end:+.1f}"
        if end < _FARTHEST_END:
            percent = f"below {100 * _FARTHEST_END:.0f}"
        ends.append(percent + unit)
    return " to ".join(ends)


def _improvement(
    metrics: Mapping[str, float], compared: Comparison, values: dict[str, float]
) -> str:
    """Returns the improvement in words, and adds its numbers to `values`."""
    geometric = 100 * metrics[f"{compared.key}/geometric"]
    low = metrics.get(f"{compared.key}/ci95_low", math.nan)
    high = metrics.get(f"{compared.key}/ci95_high", math.nan)
    values[PERCENT] = round(geometric, 1)
    text = f"{geometric:+.1f} %"
    if math.isfinite(low) and math.isfinite(high):
        values["improvement_low_percent"] = round(100 * low, 1)
        values["improvement_high_percent"] = round(100 * high, 1)
        text += f" ({interval_in_words(low, high)})"
    text += f" over {_CONSTANT[compared.baseline]}"
    if compared.scope != "test":
        text += " on full trajectories"
    estimates = {}
    for name in ("geometric", "ratio_of_means", "drivers"):
        if f"{compared.key}/{name}" in metrics:
            estimates[name] = metrics[f"{compared.key}/{name}"]
    return ", ".join([text, *doubts(estimates)])
