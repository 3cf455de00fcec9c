"""A job's headline: one number and what it is, the same wherever a job is named."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

from cfx.evaluation.metrics.base import key_of

__all__ = [
    "summaries_disagree",
]
"""What plugins may use, as `cfx.plugin.headline`."""


RESULT = "result"
"""The tag that says it in words."""

PERCENT = "improvement_percent"
SPEED_ERROR = "rmse_speed_mps"
"""The two that charts begin with. No metric of the headline has a group: MLflow puts such first."""

_JUDGED = {"rmse_gap_m": "rmse_gap", "collisions": "collisions"}
"""Further metrics of the method that a job is judged by."""

_CONSTANT = {"driver_specific": "driver-specific", "pooled": "pooled", "default": "default"}
"""Constant parameters, the first of which is a calibration's number."""


def improvement_key(baseline: str, scope: str = "test") -> str:
    """Returns how the metrics of the improvement over a baseline begin."""
    key = f"improvement/rmse_speed/{baseline}"
    return key if scope == "test" else f"{scope}/{key}"


class Comparison(NamedTuple):
    """What the policy is compared with: a baseline over a part of the trajectories."""

    baseline: str
    scope: str

    @property
    def key(self) -> str:
        """How the metrics of the improvement begin."""
        return improvement_key(self.baseline, self.scope)


_COMPARISONS = (
    Comparison("driver_specific", "test"),
    Comparison("pooled", "full_trajectory"),
    Comparison("pooled", "test"),
)
"""The first that was measured counts."""


def main_comparison(metrics: Mapping[str, float]) -> Comparison | None:
    """Returns the comparison that counts: over driver-specific parameters on the test part.

    Where there are none it is over pooled ones, on full trajectories; None if there is nothing.
    """
    for one in _COMPARISONS:
        if math.isfinite(metrics.get(f"{one.key}/geometric", math.nan)):
            return one
    return None


def lower_by(before: float, after: float) -> float:
    """Returns by what share an error is lower than one before; NaN where that is not known."""
    return (before - after) / before if before > 0 else math.nan


_CLOSE = 0.03
"""Two summaries of an improvement that differ by no more, and not in sign, say the same."""


def summaries_disagree(geometric: float, ratio_of_means: float) -> str:
    """Returns what the mean errors say where they say something else than the improvement; or "".

    Each driver counts alike in a geometric mean. Drivers with large errors outweigh the others in a
    ratio of mean errors.
    """
    if not math.isfinite(geometric) or not math.isfinite(ratio_of_means):
        return ""
    if geometric * ratio_of_means >= 0 and abs(geometric - ratio_of_means) <= _CLOSE:
        return ""
    return f"of the mean errors {100 * ratio_of_means:+.1f} %"


FEW_DRIVERS = 10
"""Of fewer drivers than these an improvement says little about others."""


def doubts(metrics: Mapping[str, float], compared: Comparison) -> list[str]:
    """Returns what is to be known beside an improvement, as parts of a sentence."""
    geometric = metrics.get(f"{compared.key}/geometric", math.nan)
    note = summaries_disagree(geometric, metrics.get(f"{compared.key}/ratio_of_means", math.nan))
    parts = [note] if note else []
    drivers = metrics.get(f"{compared.key}/drivers", math.nan)
    if drivers < FEW_DRIVERS:
        parts.append("one driver" if drivers == 1 else f"{drivers:.0f} drivers")
    return parts


def main_error(metrics: Mapping[str, float]) -> float:
    """Returns the RMSE of speed of the method that a job is judged by."""
    for method in ("policy", *_CONSTANT):
        error = metrics.get(key_of("rmse_speed", method), math.nan)
        if math.isfinite(error):
            return error
    return math.nan


def headline(metrics: Mapping[str, float]) -> tuple[dict[str, float], str]:
    """Returns a job's headline.

    A job without a method `policy` is a calibration.

    Args:
        metrics: the job's, under their names in MLflow.

    Returns:
        Metrics, rounded; and the result in words.
    """
    if key_of("rmse_speed", "policy") not in metrics and main_comparison(metrics) is None:
        values, said = _of_calibration(metrics)
    else:
        values, said = _of_policy(metrics)
    return {**values, **_further(metrics)}, said


def fitted_errors(errors: Mapping[str, float]) -> dict[str, float]:
    """Returns the headline's errors on the part that was calibrated on.

    Args:
        errors: mean `rmse_speed` (m/s) and `rmse_gap` (m) of driver-specific parameters there.
    """
    names = {"rmse_speed": "rmse_speed_fitted_mps", "rmse_gap": "rmse_gap_fitted_m"}
    found = {}
    for metric, name in names.items():
        if math.isfinite(errors.get(metric, math.nan)):
            found[name] = round(errors[metric], 3)
    return found


def _further(metrics: Mapping[str, float]) -> dict[str, float]:
    """Returns the error of each constant set, and what else is first asked of the judged method."""
    found: dict[str, float] = {}
    judged = ""
    for method in ("policy", *_CONSTANT):
        error = metrics.get(key_of("rmse_speed", method), math.nan)
        if not math.isfinite(error):
            continue
        judged = judged or method
        if method in _CONSTANT:
            found[f"rmse_speed_{_CONSTANT[method].replace('-', '_')}_mps"] = round(error, 3)
    for name, metric in _JUDGED.items():
        value = metrics.get(key_of(metric, judged), math.nan)
        if math.isfinite(value):
            found[name] = round(value, 3)
    return found


def _of_policy(metrics: Mapping[str, float]) -> tuple[dict[str, float], str]:
    values: dict[str, float] = {}
    words = []
    compared = main_comparison(metrics)
    if compared is not None:
        words.append(_improvement(metrics, compared, values))
    error = metrics.get(key_of("rmse_speed", "policy"), math.nan)
    if math.isfinite(error):
        values[SPEED_ERROR] = round(error, 3)
        said = f"RMSE of speed {error:.3f} m/s"
        if compared is not None:
            before = metrics.get(key_of("rmse_speed", compared.baseline), math.nan)
            if math.isfinite(before):
                said += f" ({_CONSTANT[compared.baseline]} {before:.3f} m/s)"
        words.append(said)
    return values, "; ".join(words)


def _improvement(
    metrics: Mapping[str, float], compared: Comparison, values: dict[str, float]
) -> str:
    """Returns the improvement in words, and adds its numbers to `values`."""
    geometric = 100 * metrics[f"{compared.key}/geometric"]
    low = 100 * metrics.get(f"{compared.key}/ci95_low", math.nan)
    high = 100 * metrics.get(f"{compared.key}/ci95_high", math.nan)
    values[PERCENT] = round(geometric, 1)
    text = f"{geometric:+.1f} %"
    if math.isfinite(low) and math.isfinite(high):
        values["improvement_low_percent"] = round(low, 1)
        values["improvement_high_percent"] = round(high, 1)
        text += f" ({low:+.1f} to {high:+.1f})"
    text += f" over {_CONSTANT[compared.baseline]}"
    if compared.scope != "test":
        text += " on full trajectories"
    return ", ".join([text, *doubts(metrics, compared)])


def _of_calibration(metrics: Mapping[str, float]) -> tuple[dict[str, float], str]:
    values: dict[str, float] = {}
    words = ["calibration"]
    for method, name in _CONSTANT.items():
        error = metrics.get(key_of("rmse_speed", method), math.nan)
        if math.isfinite(error):
            values.setdefault(SPEED_ERROR, round(error, 3))
            words.append(f"{name} {error:.3f} m/s")
    return values, "; ".join(words)
