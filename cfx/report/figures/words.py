"""The words of figures and reports: names of methods, parts of trajectories, numbers, units."""

from __future__ import annotations

import math

from cfx.evaluation.metrics.base import SCOPES
from cfx.simulation.trajectory import TRANSIENT_S

MINUS = "\N{MINUS SIGN}"
NOTHING = "\N{EN DASH}"
LABELS = {
    "real": "real driver",
    "leader": "leader",
    "default": "default parameters",
    "population": "pooled calibration",
    "fixed": "driver-specific calibration",
    "shrunk": "driver-specific, shrunk",
    "policy": "policy",
    "constant_speed": "constant speed",
    "constant_acceleration": "constant acceleration",
    "population_residual": "pooled, with residual",
    "fixed_residual": "driver-specific, with residual",
    "population_ar": "pooled, with noise",
    "fixed_ar": "driver-specific, with noise",
    "policy_sampled": "policy, sampled",
}
"""Methods and recorded vehicles as legends name them."""

SHORT = {
    "population": "pooled",
    "fixed": "driver-specific",
    "shrunk": "shrunk",
    "constant_speed": "constant speed",
    "constant_acceleration": "constant acceleration",
    "population_residual": "pooled + residual",
    "fixed_residual": "driver-specific + residual",
    "population_ar": "pooled + noise",
    "fixed_ar": "driver-specific + noise",
    "policy_sampled": "policy, sampled",
}
"""Methods as tables name them, where the key of the metrics says too little."""

EXPLAINED = {
    "real": "the recorded drivers",
    "default": "the model's default parameters",
    "population": "pooled calibration, which is one set of parameters for all drivers, calibrated"
    " jointly on the training drivers",
    "fixed": "driver-specific calibration, which is one set of parameters for each driver,"
    " calibrated on the first part of their own trajectory",
    "shrunk": "driver-specific calibration shrunk towards the default, which is where the policy"
    " starts from",
    "policy": "parameters that the policy chooses anew in each window",
    "constant_speed": "the driver goes on at the speed that they have",
    "constant_acceleration": "the driver goes on at the acceleration that they have",
    "population_residual": "pooled calibration, which takes over from the acceleration at the"
    " origin within seconds",
    "fixed_residual": "driver-specific calibration, which takes over from the acceleration at the"
    " origin within seconds",
    "population_ar": "pooled calibration with auto-regressive noise on the acceleration, as"
    " measured on recorded drivers",
    "fixed_ar": "driver-specific calibration with auto-regressive noise on the acceleration, as"
    " measured on the driver",
    "policy_sampled": "the policy with all that it leaves to chance, drawn with the job's seed",
}
"""Methods in words that end a sentence."""

FEW_DRIVERS = 20

TEST, STEADY, FULL_TRAJECTORY = SCOPES
"""Parts of trajectories that metrics are of."""


def label(method: str) -> str:
    """Returns how a legend names a method."""
    return LABELS.get(method, method)


def short_label(method: str) -> str:
    """Returns how a table names a method."""
    return SHORT.get(method, method)


def explained(method: str) -> str:
    """Returns what a method is, in words that end a sentence."""
    return EXPLAINED.get(method, method)


def scope_label(scope: str, transient_s: float = TRANSIENT_S) -> str:
    """Returns how a part of trajectories is named: "test part after the first 5 s".

    Args:
        scope: one of `SCOPES`, or the name of another part, which is returned as it is.
        transient_s: length of the transient at the beginning of the test part, s.
    """
    if scope == TEST:
        return "test part"
    if scope == STEADY:
        return f"test part after the first {transient_s:g} s"
    if scope == FULL_TRAJECTORY:
        return "full trajectories"
    return scope


def percent(fraction: float, digits: int = 0) -> str:
    """Returns a signed percentage with a real minus sign: 0.1234 -> "+12 %"."""
    return f"{100 * fraction:+.{digits}f} %".replace("-", MINUS)


def percent_or_undefined(fraction: float, digits: int = 0) -> str:
    """Returns a signed percentage, or "undefined" where it is not finite."""
    if not math.isfinite(fraction):
        return "undefined"
    return percent(fraction, digits)


def number(value: float) -> str:
    """Returns up to three significant digits, with a real minus sign."""
    return f"{value:.3g}".replace("-", MINUS)


def plural(count: int, noun: str) -> str:
    """Returns "1 pair" or "3 pairs"."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def few_drivers(drivers: int) -> str:
    """Returns a warning where statistics are over few drivers, else "".

    A bootstrap interval over fewer than twenty is too narrow.
    """
    if not 0 < drivers < FEW_DRIVERS:
        return ""
    return (
        f"{plural(drivers, 'driver')}: with fewer than {FEW_DRIVERS}, means and intervals say"
        " little about other drivers."
    )


def short(name: str, limit: int = 26) -> str:
    """Returns a name that fits, its middle left out if it is longer than `limit` characters."""
    if len(name) <= limit:
        return name
    tail = (limit - 1) // 2
    return f"{name[: limit - 1 - tail]}…{name[-tail:]}"


def common_prefix(names: list[str]) -> str:
    """Returns what all names start with, up to a separator: "i80-" of "i80-11-1" and "i80-12-7"."""
    if len(names) < 2:
        return ""
    # The first and the last in alphabetical order differ earliest.
    first, last = min(names), max(names)
    same = 0
    while same < min(len(first), len(last)) and first[same] == last[same]:
        same += 1
    end = 0
    for separator in "_-/:.":
        end = max(end, first.rfind(separator, 0, same) + 1)
    return first[:end]


def unit_label(name: str, unit: str) -> str:
    """Returns an axis label such as "t_r (s)"; a pure number (unit "1" or "") has no bracket."""
    return name if unit in {"", "1"} else f"{name} ({pretty_unit(unit)})"


def pretty_unit(unit: str) -> str:
    """Returns a unit with raised digits: "m/s2" -> "m/s²"."""
    for plain, raised in (
        ("1e-4", "10⁻⁴"),
        ("m/s2", "m/s²"),
        ("m2/s2", "m²/s²"),
        ("m/s3", "m/s³"),
    ):
        unit = unit.replace(plain, raised)
    return unit
