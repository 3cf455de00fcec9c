"""What a command line enters: a method of cfx by overrides, or a rival by its name and settings."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import yaml

from cfx.errors import ConfigError
from cfx.plugin import folder_of as folder_of_run
from cfx.plugin import load_agent, registry
from cfx_report.benchmark.constants import are_constant
from cfx_report.benchmark.jobs import (
    as_file_name,
    of_method,
    overrides_of,
    require_free,
    row_name,
)
from cfx_report.benchmark.methods import (
    ConstantEntry,
    Entry,
    JobEntry,
    ReadyEntry,
    RivalEntry,
)
from cfx_report.benchmark.rival import Rival
from cfx_report.benchmark.suite import Suite

_SEED = ", seed "
"""Stands in a row's name before a seed of training that is not 0."""


def without_seed(row: str) -> str:
    """Returns the name that rows of one method have in common, whatever their seed."""
    return re.sub(rf"{_SEED}\d+$", "", row)


def entry_of(method: str | None, overrides: Sequence[str], name: str | None, seed: int) -> Entry:
    """Returns what enters.

    Args:
        method: how a model of cfx is used; None: with constant parameters, unless a policy or a
            learner is given.
        overrides: of a job; or `rival=NAME` and `rival.SETTING=VALUE`; or `driver=` with a
            ready-made policy or a job's folder, where nothing is learned.
        name: of the row; None: made of the overrides.
        seed: of training, named in the row where it is not 0.

    Raises:
        ConfigError: an override changes what is frozen, or there is no such rival.
    """
    suffix = f"{_SEED}{seed}" if seed else ""
    if any(word.partition("=")[0] == "rival" for word in overrides):
        if method is not None:
            raise ConfigError("--method says how a model of cfx is used; a rival has none")
        row = name or ", ".join(word.removeprefix("rival=") for word in overrides) + suffix
        return RivalEntry(row, tuple(overrides), _rival(overrides))
    if any(word.startswith("driver=") for word in overrides):
        if len(overrides) != 1 or method is not None:
            raise ConfigError(f"{overrides[0]} stands alone: it brings its model and its settings")
        run = overrides[0].removeprefix("driver=")
        agent = load_agent(folder_of_run(run) / "policy").for_unseen_drivers()
        return ReadyEntry(name or run, tuple(overrides), agent)
    require_free(overrides)
    words = overrides_of(method, overrides)
    row = name or row_name(method, overrides) + suffix
    made = ConstantEntry if are_constant(words) else JobEntry
    return made(row, tuple(of_method(words)), tuple(words))


def _rival(overrides: Sequence[str]) -> Rival:
    """Makes a rival of its name and its settings.

    Raises:
        ConfigError: an override is none of a rival's.
    """
    node: dict[str, Any] = {}
    for word in overrides:
        key, separator, value = word.partition("=")
        if not separator or (key != "rival" and not key.startswith("rival.")):
            raise ConfigError(
                f"{word}: beside rival= stand its settings alone, such as rival.moments=2000 (cfx"
                " plugins show rival NAME lists them)"
            )
        node[key.removeprefix("rival.").replace("rival", "name")] = yaml.safe_load(value)
    return cast(Rival, registry.create("rival", node))


def folder_of(suite: Suite, name: str, root: Path | None = None) -> Path:
    """Returns the folder of a row.

    Args:
        suite: that it is of.
        name: of the row.
        root: where rows of this suite lie; None: below `outputs/benchmark`.
    """
    if root is None:
        root = Path("outputs/benchmark")
        if suite.name != "i80":
            root /= suite.version
    return root / as_file_name(name)
