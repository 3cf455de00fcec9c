"""Names of the version before: they work for one version more, and a warning says the new one.

Everything that users wrote down is looked up here: overrides and configuration files, what saved
policies and job folders hold, metrics and columns of results, and the public Python names.
"""

from __future__ import annotations

import logging
import re
import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas as pd

log = logging.getLogger(__name__)

SETTINGS: dict[str, str] = {
    "learner.members": "learner.ensemble_size",
    "learner.strangers": "learner.cold_start_fraction",
    "learner.reading": "learner.burn_in_s",
    "learner.taught": "learner.distillation_epochs",
    "learner.damping": "learner.gradient_decay",
    "learner.gradient_bound": "learner.gradient_clip_state",
    "learner.truncation": "learner.tbptt_windows",
    "learner.smoothing": "learner.temperature",
    "learner.smoothing_end": "learner.temperature_end",
    "learner.weight_by_spread": "learner.weight_by_sensitivity",
    "model.reach": "model.adaptation_bounds",
    "policy.traits": "policy.driver_features",
    "simulation.compile": "simulator.compile",
    "simulation.memory_mb": "simulator.memory_mb",
}
"""Paths in the configuration: the old one and the new one."""

OPTIONS: dict[tuple[str, str], str] = {
    ("experiment", "known_drivers"): "with_history",
    ("experiment", "told_drivers"): "conditioned",
    ("experiment", "strangers"): "unseen_drivers",
    ("experiment", "calm_strangers"): "unseen_drivers_smooth",
    ("learner", "rollout_taught"): "rollout_distilled",
    ("model", "w99_reaching"): "w99_wide",
}
"""Options of config groups: group and old name, and the new name."""

PUBLIC: dict[str, str] = {
    "Lesson": "TrainingData",
    "Learned": "TrainingResult",
    "Study": "ProtocolContext",
    "Outcome": "ProtocolResult",
}
"""Names that `import cfx` had."""

_METRICS: tuple[tuple[str, str], ...] = (
    (r"^later/", "steady/"),
    (r"^whole/", "full_trajectory/"),
    (r"^labels/spread$", "labels/sensitivity"),
    (r"(?<=/)base(?=/|$)", "shrunk"),
)

_COLUMNS: tuple[tuple[str, str], ...] = (
    (r"^later_rmse_speed$", "steady_rmse_speed"),
    (r"^whole_", "full_trajectory_"),
    (r"^loss_mps$", "loss"),
    (r"^spread_mps$", "sensitivity"),
    (r"_base$", "_shrunk"),
)

_FILES = {"trajectories.parquet": "drives.parquet"}
"""Files of a job's folder: today's name and the earlier one."""

_DATA = {"follows": "has_constant_baseline"}
"""Keys of `data.json`: the earlier one and today's."""

_OVERRIDE = re.compile(r"(?P<sign>[+~]*)(?P<key>[^=@\s]+)(?P<package>@[^=]*)?(?P<value>=.*)?", re.S)


def overrides(arguments: Sequence[str]) -> list[str]:
    """Returns command-line arguments with today's names; warns of each that was renamed."""
    return [_override(one) for one in arguments]


def node(group: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """Returns a component's config node with today's keys; warns of each that was renamed.

    Args:
        group: the config group, such as `learner`.
        values: the node; where it holds both names, the old one was written by hand and counts.
    """
    renamed = dict(values)
    for old, new in SETTINGS.items():
        parent, _, key = old.rpartition(".")
        if parent == group and key in renamed:
            log.warning("%s is now called %s; the old name goes with the next version", old, new)
            renamed[new.rpartition(".")[2]] = renamed.pop(key)
    name = renamed.get("name")
    if isinstance(name, str) and (group, name) in OPTIONS:
        renamed["name"] = _option(group, name)
    return renamed


def config(values: Mapping[str, Any]) -> Mapping[str, Any]:
    """Returns a job's configuration with today's groups; warns of each that was renamed.

    Args:
        values: the resolved configuration, such as a job's `config.yaml`.
    """
    earlier = values.get("simulation")
    if not isinstance(earlier, Mapping):
        return values
    current = dict(values)
    simulator = dict(current.get("simulator") or {"name": "memory"})
    kept = dict(earlier)
    for key in earlier:
        new = SETTINGS.get(f"simulation.{key}")
        if new is None:
            continue
        value = kept.pop(key)
        text = "simulation.%s is now called %s; the old name goes with the next version"
        log.warning(text, key, new)
        if key == "compile" and simulator.get("name") != "memory":
            continue  # compiling was always the in-memory simulator's alone
        simulator[key] = value
    current["simulator"] = simulator
    if kept:
        current["simulation"] = kept  # what is left was never there, and is refused by name
    else:
        del current["simulation"]
    return current


def metric(name: str) -> str:
    """Returns today's name of a metric."""
    return _replaced(name, _METRICS)


def metrics(values: Mapping[str, float]) -> Metrics:
    """Returns metrics that may come from an earlier version under today's names."""
    return Metrics({metric(name): value for name, value in values.items()})


def file(path: Path) -> Path:
    """Returns the file of a job's folder, under its earlier name where only that is there."""
    earlier = _FILES.get(path.name)
    if earlier is None or path.exists() or not path.with_name(earlier).exists():
        return path
    return path.with_name(earlier)


def data(values: Mapping[str, Any]) -> dict[str, Any]:
    """Returns what `data.json` says under today's names."""
    return {_DATA.get(name, name): value for name, value in values.items()}


def results(table: pd.DataFrame) -> pd.DataFrame:
    """Returns a table of results with today's columns and names of methods."""
    table = table.rename(columns=columns(table.columns))
    if "method" in table:
        table["method"] = table["method"].replace({"base": "shrunk"})
    return table


def columns(names: Iterable[str]) -> dict[str, str]:
    """Returns which columns of a table of results have other names today, old -> new."""
    found = {}
    for name in names:
        new = _replaced(name, _COLUMNS)
        if new != name:
            found[name] = new
    return found


def public(name: str) -> str | None:
    """Returns today's name of a name that `import cfx` had; None if it had none such.

    Warns that the old name goes.
    """
    new = PUBLIC.get(name)
    if new is not None:
        text = f"cfx.{name} is now called cfx.{new}; the old name goes with the next version"
        warnings.warn(text, DeprecationWarning, stacklevel=3)
    return new


class Metrics(dict[str, float]):
    """Metrics by name, which also answer to the names of the version before."""

    def __missing__(self, name: str) -> float:
        new = metric(name)
        if new == name or new not in self:
            raise KeyError(name)
        text = f"the metric {name} is now called {new}; the old name goes with the next version"
        warnings.warn(text, DeprecationWarning, stacklevel=2)
        return self[new]


def _override(argument: str) -> str:
    found = _OVERRIDE.fullmatch(argument)
    if argument.startswith("-") or found is None:
        return argument
    key, value = found["key"], found["value"] or ""
    new_key, new_value = _path(key), value
    if any(group == key for group, _ in OPTIONS):
        chosen = value.removeprefix("=").split(",")
        new_value = "=" + ",".join(_option(key, name) for name in chosen) if value else ""
    if new_key != key:
        log.warning("%s is now called %s; the old name goes with the next version", key, new_key)
    return f"{found['sign']}{new_key}{found['package'] or ''}{new_value}"


def _path(key: str) -> str:
    for old, new in SETTINGS.items():
        if key == old or key.startswith(f"{old}."):
            return new + key.removeprefix(old)
    return key


def _option(group: str, name: str) -> str:
    new = OPTIONS.get((group, name))
    if new is None:
        return name
    text = "%s=%s is now called %s=%s; the old name goes with the next version"
    log.warning(text, group, name, group, new)
    return new


def _replaced(name: str, patterns: Sequence[tuple[str, str]]) -> str:
    for pattern, new in patterns:
        name = re.sub(pattern, new, name)
    return name
