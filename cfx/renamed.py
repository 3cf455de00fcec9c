"""Names of the version before: they work for one version more, and a warning says the new one.

Everything that users wrote down is looked up here: overrides and configuration files, what saved
policies and job folders hold, metrics and columns of results, attributes of plugins' classes, and
the public Python names.
"""

from __future__ import annotations

import logging
import re
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import deepcopy
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

REMOVED: dict[str, str] = {
    "learner.error": "the loss is the job's objective; choose objective=speed_rmse or speed_huber",
    "learner.huber_delta": "write objective=speed_huber objective.delta=...",
    "learner.normalise": "losses are always divided by those of the base parameters",
}
"""Paths in the configuration that are gone: the old one, and a sentence that says what to do.

A setting that is given all the same is left out, with a warning.
"""

ONLY_OF: dict[str, str] = {"simulator.compile": "memory"}
"""New paths that one option of their group has alone.

With another option, the old path is left out.
"""

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

ATTRIBUTES: dict[str, str] = {
    "follows": "has_constant_baseline",
    "reach": "adaptation_space",
    "softness": "temperature",
    "smoothed": "at_temperature",
    "traits": "driver_features",
    "reads_traits": "uses_driver_features",
    "require_no_traits": "require_no_driver_features",
    "traits_of": "driver_features_of",
    "read": "burn_in",
}
"""Attributes of components and of a job's policy, which plugins read."""

ARGUMENTS = {"traits": "driver_features"}
"""Keyword arguments of `cfx.sumo.Driver.assign`."""

DECLARED = ("follows", "reads_traits")
"""Those of them that plugins' classes set."""

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
    (r"^rms_jerk$", "jerk"),
    (r"^real_rms_jerk$", "real_jerk"),
    (r"^spread_mps$", "sensitivity"),
    (r"_base$", "_shrunk"),
)

_FILES = {"trajectories.parquet": "drives.parquet"}
"""Files of a job's folder: today's name and the earlier one."""

_DATA = {"follows": "has_constant_baseline"}
"""Keys of `data.json`: the earlier one and today's."""

_OVERRIDE = re.compile(r"(?P<sign>[+~]*)(?P<key>[^=@\s]+)(?P<package>@[^=]*)?(?P<value>=.*)?", re.S)

_GONE = "the old name goes with the next version"


def _never(_: str) -> bool:
    return False


# ---- the command line and configuration files


def overrides(arguments: Sequence[str], is_current: Callable[[str], bool] = _never) -> list[str]:
    """Returns command-line arguments with today's names; warns of each that was renamed or is gone.

    Args:
        arguments: as typed.
        is_current: says of an old path whether it is a setting of today all the same, because the
            component that was chosen has one of that name.
    """
    kept = []
    for argument in arguments:
        new = _override(argument, is_current)
        if new is not None:
            kept.append(new)
    return kept


def config(values: Mapping[str, Any]) -> dict[str, Any]:
    """Returns a configuration in which settings that went to another group stand there; warns.

    Args:
        values: the resolved configuration, such as a job's `config.yaml`. What was renamed within
            a group is for `node`.
    """
    renamed = dict(values)
    for old, new in SETTINGS.items():
        group, _, key = old.rpartition(".")
        if group == _group(new) or not _holds(renamed.get(group), key):
            continue
        _say_new_name(old, new)
        kept = dict(renamed[group])
        value = kept.pop(key)
        renamed[group] = kept
        if not kept:
            del renamed[group]
        _put(renamed, new, value)
    return renamed


def node(
    group: str,
    values: Mapping[str, Any],
    is_current: Callable[[str], bool] = _never,
    *,
    warn: bool = True,
) -> dict[str, Any]:
    """Returns a component's config node with today's keys.

    Where a node holds both names, the old one was written by hand and counts.

    Args:
        group: the config group, such as `learner`.
        values: the node.
        is_current: says of an old path whether it is a setting of today all the same, because the
            component that was chosen has one of that name.
        warn: log a warning of each key that was renamed; a saved policy's node is nobody's fault.
    """
    renamed: dict[str, Any] = {group: dict(values)}
    for old, new in SETTINGS.items():
        if not _is_old(renamed, group, old, is_current) or _group(new) != group:
            continue
        value = renamed[group].pop(_key(old))
        _put(renamed, new, value)
        if warn:
            _say_new_name(old, new)
    for old, sentence in REMOVED.items():
        if _is_old(renamed, group, old, is_current):
            del renamed[group][_key(old)]
            if warn:
                _say_gone(old, sentence)
    current: dict[str, Any] = renamed[group]
    name = current.get("name")
    if isinstance(name, str) and (group, name) in OPTIONS:
        current["name"] = OPTIONS[group, name]
        if warn:
            _say_new_option(group, name)
    return current


def option(group: str, name: str) -> str | None:
    """Returns today's name of an option of a config group, and warns; None if it has no other."""
    new = OPTIONS.get((group, name))
    if new is not None:
        _say_new_option(group, name)
    return new


# ---- results


def metric(name: str) -> str:
    """Returns today's name of a metric."""
    return _replaced(name, _METRICS)


def metrics(values: Mapping[str, float]) -> Metrics:
    """Returns metrics that may come from an earlier version under today's names."""
    found = Metrics()
    for name, value in values.items():
        found[metric(name)] = value
    return found


def file(path: Path) -> Path:
    """Returns the file of a job's folder, under its earlier name where only that is there."""
    earlier = _FILES.get(path.name)
    if earlier is None or path.exists() or not path.with_name(earlier).exists():
        return path
    return path.with_name(earlier)


def data(values: Mapping[str, Any]) -> dict[str, Any]:
    """Returns what `data.json` says under today's names."""
    found = {}
    for name, value in values.items():
        found[_DATA.get(name, name)] = value
    return found


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


class Metrics(dict[str, float]):
    """Metrics by name, which also answer to the names of the version before."""

    def __missing__(self, name: str) -> float:
        new = metric(name)
        if new == name or not super().__contains__(new):
            raise KeyError(name)
        text = f"the metric {name} is now called {new}; {_GONE}"
        warnings.warn(text, DeprecationWarning, stacklevel=2)
        return self[new]

    def __contains__(self, name: object) -> bool:
        if super().__contains__(name):
            return True
        return isinstance(name, str) and super().__contains__(metric(name))

    def get(self, name: str, default: Any = None) -> Any:
        """Returns a metric under today's name or that of the version before."""
        if name in self:
            return self[name]
        return default


# ---- Python


def public(name: str) -> str | None:
    """Returns today's name of a name that `import cfx` had; None if it had none such.

    Warns that the old name goes.
    """
    new = PUBLIC.get(name)
    if new is not None:
        text = f"cfx.{name} is now called cfx.{new}; {_GONE}"
        warnings.warn(text, DeprecationWarning, stacklevel=3)
    return new


def declared(cls: type) -> dict[str, Any]:
    """Returns what a component's class sets under an earlier name, under today's; warns."""
    found = {}
    for name in DECLARED:
        if name in vars(cls):
            new = attribute(cls, name)
            if new is not None:
                found[new] = vars(cls)[name]
    return found


def attribute(owner: type, name: str) -> str | None:
    """Returns today's name of an attribute of a component; None if it never had another.

    Warns that the old name goes.
    """
    new = ATTRIBUTES.get(name)
    if new is None or not hasattr(owner, new):
        return None
    text = f"{owner.__name__}.{name} is now called {new}; {_GONE}"
    warnings.warn(text, DeprecationWarning, stacklevel=3)
    return new


def arguments(given: Mapping[str, Any]) -> dict[str, Any]:
    """Returns keyword arguments that a function was given by their earlier names, under today's.

    Warns that the old names go.

    Raises:
        TypeError: there never was such an argument.
    """
    found = {}
    for old, value in given.items():
        if old not in ARGUMENTS:
            raise TypeError(f"unexpected keyword argument '{old}'")
        text = f"the argument {old} is now called {ARGUMENTS[old]}; {_GONE}"
        warnings.warn(text, DeprecationWarning, stacklevel=3)
        found[ARGUMENTS[old]] = value
    return found


# ---- helpers


def _override(argument: str, is_current: Callable[[str], bool]) -> str | None:
    """Returns one argument with today's names; None if its setting is gone."""
    found = _OVERRIDE.fullmatch(argument)
    if argument.startswith("-") or found is None:
        return argument
    key, value = found["key"], found["value"] or ""
    for old, sentence in REMOVED.items():
        if _lies_at(key, old) and not is_current(old):
            _say_gone(old, sentence)
            return None
    if any(group == key for group, _ in OPTIONS):
        value = _options(key, value)
    return f"{found['sign']}{_path(key, is_current)}{found['package'] or ''}{value}"


def _path(key: str, is_current: Callable[[str], bool]) -> str:
    for old, new in SETTINGS.items():
        if _lies_at(key, old) and not is_current(old):
            _say_new_name(old, new)
            return new + key.removeprefix(old)
    return key


def _options(group: str, value: str) -> str:
    """Returns what was chosen, one option or a sweep over several, under today's names."""

    def replace(word: re.Match[str]) -> str:
        return option(group, word[0]) or word[0]

    return re.sub(r"[\w/.-]+", replace, value)


def _lies_at(key: str, path: str) -> bool:
    return key == path or key.startswith(f"{path}.")


def _group(path: str) -> str:
    return path.partition(".")[0]


def _key(path: str) -> str:
    return path.partition(".")[2]


def _holds(values: Any, key: str) -> bool:
    return isinstance(values, Mapping) and key in values


def _is_old(
    values: Mapping[str, Any], group: str, old: str, is_current: Callable[[str], bool]
) -> bool:
    return _group(old) == group and _holds(values[group], _key(old)) and not is_current(old)


def _put(values: dict[str, Any], path: str, value: Any) -> None:
    """Sets a value at a path of nested mappings, which are copied on the way."""
    group = _group(path)
    only = ONLY_OF.get(path)
    if only is not None and _holds(values.get(group), "name") and values[group]["name"] != only:
        return
    *parents, last = path.split(".")
    current = values
    for part in parents:
        nested = current.get(part)
        current[part] = deepcopy(dict(nested)) if isinstance(nested, Mapping) else {}
        current = current[part]
    current[last] = value


def _say_new_name(old: str, new: str) -> None:
    log.warning("%s is now called %s; %s", old, new, _GONE)


def _say_new_option(group: str, name: str) -> None:
    new = OPTIONS[group, name]
    log.warning("%s=%s is now called %s=%s; %s", group, name, group, new, _GONE)


def _say_gone(old: str, sentence: str) -> None:
    log.warning("%s is gone and was left out: %s", old, sentence)


def _replaced(name: str, patterns: Sequence[tuple[str, str]]) -> str:
    for pattern, new in patterns:
        name = re.sub(pattern, new, name)
    return name
