"""What a table of runs shows first: a job's result in words, in percent and with three digits."""

from __future__ import annotations

import math
from collections.abc import Mapping

RESULT = "result"
"""The tag that says it in words."""

PERCENT = "improvement_percent"
SPEED_ERROR = "rmse_speed_mps"
"""Metrics that charts show first: they have no group, and MLflow puts such metrics first."""

_IMPROVEMENT = "rmse_improvement"
_PARTS = ("", "steady/", "full_trajectory/")


def without_improvements(metrics: Mapping[str, float]) -> dict[str, float]:
    """Returns metrics without the improvements of a policy that is no other than its baselines."""
    beginnings = tuple(part + _IMPROVEMENT for part in _PARTS)
    return {name: value for name, value in metrics.items() if not name.startswith(beginnings)}


def headline(metrics: Mapping[str, float], *, adapts: bool) -> tuple[dict[str, float], str]:
    """Returns a job's headline.

    The improvement is over driver-specific parameters on the test part, or, where there are none,
    over pooled ones on full trajectories.

    Args:
        metrics: the job's, under their names in MLflow.
        adapts: whether its policy may change parameters; if not, it is a calibration.

    Returns:
        Metrics, rounded; and the result in words.
    """
    values: dict[str, float] = {}
    words = []
    if adapts:
        prefix, over = _main_improvement(metrics)
        if prefix:
            mean = 100 * metrics[f"{prefix}/mean"]
            low, high = (100 * metrics.get(f"{prefix}/ci95_{end}", math.nan) for end in ENDS)
            values[PERCENT] = round(mean, 1)
            text = f"{mean:+.1f} %"
            if math.isfinite(low) and math.isfinite(high):
                values["improvement_low_percent"] = round(low, 1)
                values["improvement_high_percent"] = round(high, 1)
                text += f" ({low:+.1f} to {high:+.1f})"
            words.append(f"{text} over {over}")
    else:
        words.append("calibration")
    for method, name in _ERRORS[adapts]:
        error = metrics.get(f"rmse_speed/{method}", math.nan)
        if math.isfinite(error):
            values.setdefault(SPEED_ERROR, round(error, 3))
            words.append(f"{name} {error:.3f} m/s")
    return values, "; ".join(words)


ENDS = ("low", "high")

_ERRORS = {
    True: (("policy", "RMSE of speed"),),
    False: (("fixed", "driver-specific"), ("population", "pooled"), ("default", "default")),
}
"""Whose errors are named: the policy's; of a calibration those of each constant set."""


def _main_improvement(metrics: Mapping[str, float]) -> tuple[str, str]:
    """Returns how the metrics of the main improvement begin, and over what it is; "" for none."""
    for prefix, over in (
        (_IMPROVEMENT, "driver-specific"),
        (f"full_trajectory/{_IMPROVEMENT}/population", "pooled"),
        (f"{_IMPROVEMENT}/population", "pooled"),
    ):
        if math.isfinite(metrics.get(f"{prefix}/mean", math.nan)):
            return prefix, over
    return "", ""
