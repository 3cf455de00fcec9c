"""Words of figures and reports: names of methods, parts of trajectories, numbers, units."""

from __future__ import annotations

import math
import os
import re
from typing import NamedTuple

from cfx.evaluation.headline import FEW_DRIVERS, interval_in_words
from cfx.evaluation.metrics.base import SCOPES

__all__ = [
    "FULL_TRAJECTORY",
    "MINUS",
    "NOTHING",
    "STEADY",
    "TEST",
    "common_prefix",
    "explained",
    "few_drivers",
    "method_label",
    "number_text",
    "percent",
    "percent_interval",
    "percent_or_undefined",
    "plural",
    "pretty_unit",
    "short_label",
    "shortened",
    "unit_label",
]
"""What plugins may use, as `cfx.plugin.wording`."""


MINUS = "\N{MINUS SIGN}"
"""Stands before negative numbers in figures and tables."""

NOTHING = "\N{EN DASH}"
"""Stands in a cell of a table that has no value."""


class MethodText(NamedTuple):
    """What a method is called.

    Attributes:
        label: in legends.
        short: in tables.
        explained: in words that end a sentence.
    """

    label: str
    short: str
    explained: str


METHOD_TEXTS: dict[str, MethodText] = {
    "real": MethodText("real driver", "real", "the recorded drivers"),
    "leader": MethodText("leader", "leader", "the recorded leader"),
    "default": MethodText("default parameters", "default", "the model's default parameters"),
    "pooled": MethodText(
        "pooled calibration",
        "pooled",
        "pooled calibration, which is one set of parameters for all drivers, calibrated jointly"
        " on the training drivers",
    ),
    "driver_specific": MethodText(
        "driver-specific calibration",
        "driver-specific",
        "driver-specific calibration, which is one set of parameters for each driver, calibrated"
        " on the first part of their own trajectory",
    ),
    "shrunk": MethodText(
        "driver-specific, shrunk",
        "shrunk",
        "driver-specific calibration shrunk towards the default, which is where the policy starts"
        " from",
    ),
    "policy": MethodText(
        "policy", "policy", "parameters that the policy chooses anew in each window"
    ),
    "constant_speed": MethodText(
        "constant speed", "constant speed", "the driver goes on at the speed that they have"
    ),
    "constant_acceleration": MethodText(
        "constant acceleration",
        "constant acceleration",
        "the driver goes on at the acceleration that they have",
    ),
    "pooled_residual": MethodText(
        "pooled, with residual",
        "pooled + residual",
        "pooled calibration, which takes over from the acceleration at the origin within seconds",
    ),
    "driver_specific_residual": MethodText(
        "driver-specific, with residual",
        "driver-specific + residual",
        "driver-specific calibration, which takes over from the acceleration at the origin within"
        " seconds",
    ),
    "pooled_ar": MethodText(
        "pooled, with noise",
        "pooled + noise",
        "pooled calibration with auto-regressive noise on the acceleration, as measured on"
        " recorded drivers",
    ),
    "driver_specific_ar": MethodText(
        "driver-specific, with noise",
        "driver-specific + noise",
        "driver-specific calibration with auto-regressive noise on the acceleration, as measured"
        " on the driver",
    ),
    "policy_sampled": MethodText(
        "policy, sampled",
        "policy, sampled",
        "the policy with all that it leaves to chance, drawn with the job's seed",
    ),
}
"""Methods and recorded vehicles."""


TEST, STEADY, FULL_TRAJECTORY = SCOPES
"""Parts of trajectories that metrics are of."""


def method_label(method: str) -> str:
    """Returns how a legend names a method."""
    return METHOD_TEXTS[method].label if method in METHOD_TEXTS else method


def short_label(method: str) -> str:
    """Returns how a table names a method."""
    return METHOD_TEXTS[method].short if method in METHOD_TEXTS else method


def explained(method: str) -> str:
    """Returns what a method is, in words that end a sentence."""
    return METHOD_TEXTS[method].explained if method in METHOD_TEXTS else method


def percent(fraction: float, digits: int = 0) -> str:
    """Returns a signed percentage with a real minus sign: 0.1234 -> "+12 %"."""
    return f"{100 * fraction:+.{digits}f} %".replace("-", MINUS)


def percent_interval(low: float, high: float) -> str:
    """Returns an interval of signed percentages with real minus signs."""
    return interval_in_words(low, high, " %").replace("-", MINUS)


def percent_or_undefined(fraction: float, digits: int = 0) -> str:
    """Returns a signed percentage, or "undefined" where it is not finite."""
    return percent(fraction, digits) if math.isfinite(fraction) else "undefined"


def number_text(value: float) -> str:
    """Returns up to three significant digits, with a real minus sign."""
    return f"{value:.3g}".replace("-", MINUS)


def plural(count: int, noun: str) -> str:
    """Returns "1 pair" or "3 pairs"."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def few_drivers(drivers: int) -> str:
    """Returns a warning where statistics are over few drivers, else "".

    Their interval holds; what is uncertain is whether they stand for others.
    """
    if not 0 < drivers < FEW_DRIVERS:
        return ""
    return (
        f"{plural(drivers, 'driver')}: with fewer than {FEW_DRIVERS}, an improvement says little"
        " about other drivers."
    )


def shortened(name: str, limit: int = 26) -> str:
    """Returns a name that fits, its middle left out if it is longer than `limit` characters."""
    if len(name) <= limit:
        return name
    tail = (limit - 1) // 2
    return f"{name[: limit - 1 - tail]}…{name[-tail:]}"


def common_prefix(names: list[str]) -> str:
    """Returns what all names start with, up to a separator: "i80-" of "i80-11-1" and "i80-12-7"."""
    if len(names) < 2:
        return ""
    return re.sub(r"[^_\-/:.]*$", "", os.path.commonprefix(names))  # noqa: RUF071 - they are no paths


def unit_label(name: str, unit: str) -> str:
    """Returns an axis label such as "t_r (s)"; a pure number (unit "1" or "") has no bracket."""
    return name if unit in {"", "1"} else f"{name} ({pretty_unit(unit)})"


def pretty_unit(unit: str) -> str:
    """Returns a unit with raised digits: "m/s2" -> "m/s²"."""
    unit = unit.replace("1e-4", "10⁻⁴")
    return re.sub(r"(?<=[ms])[234]", lambda match: "²³⁴"["234".index(match[0])], unit)
