"""The jobs of cfx's own methods: which overrides are free, and running one that goes on."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Sequence
from pathlib import Path

from cfx.errors import ConfigError, DataError, Terminated, nearest
from cfx.plugin import files
from cfx_report.benchmark.frozen import FROZEN_KEYS, HISTORY, METHODS

_CHANGE_NOTHING = (
    "tracking",
    "output",
    "figures",
    "cores",
    "threads",
    "cache",
    "demo",
    "engine",
    "hydra",
)
"""Keys of a configuration that results do not depend on."""

_SECONDS = "benchmark_seconds.txt"
"""How long the job took, kept with it."""


def overrides_of(method: str | None, given: Sequence[str]) -> list[str]:
    """Returns a job's overrides: a method's, then what the user gives.

    Raises:
        ConfigError: there is no such method.
    """
    if method is None:
        chooses = {"policy", "learner", "experiment"}
        if any(override.partition("=")[0] in chooses for override in given):
            return list(given)
        method = "constant"
    if method not in METHODS:
        raise ConfigError(
            f"--method {method}: there is no such method.{nearest(method, METHODS)} Known:"
            f" {', '.join(METHODS)}; or choose policy= and learner= yourself"
        )
    return [*METHODS[method], *given]


def row_name(method: str | None, given: Sequence[str]) -> str:
    """Returns what a row is called where its user gives it no name."""
    words = []
    for override in of_method(given):
        key, _, value = override.partition("=")
        if key in {"model", "policy", "learner", "experiment"}:
            words.append(value)
        else:
            words.append(override)
    if method is not None:
        words.append(method.replace("_", " "))
    elif not any(override.startswith(("policy=", "learner=", "experiment=")) for override in given):
        words.append("constant")
    return ", ".join(words)


def of_method(overrides: Sequence[str]) -> list[str]:
    """Returns the overrides without those that change no result."""
    relevant = []
    for override in overrides:
        if override.partition("=")[0].split(".")[0] not in _CHANGE_NOTHING:
            relevant.append(override)
    return relevant


def require_free(overrides: Sequence[str]) -> None:
    """Raises ConfigError for an override of what is frozen."""
    for override in overrides:
        key = override.partition("=")[0].lstrip("+~")
        if key != HISTORY and key.split(".")[0].split("@")[0] in FROZEN_KEYS:
            raise ConfigError(
                f"cfx benchmark: {override}: pairs, folds, seed, split, windows and metrics are the"
                " benchmark's; without them rows do not compare. A job of your own: python -m cfx"
            )


def run_job(command: Sequence[str], job: Path) -> None:
    """Runs a job, unless the same one is finished there.

    Raises:
        ConfigError: the folder holds another job.
        DataError: it failed; its own words stand above.
        KeyboardInterrupt, Terminated: it was broken off; the same command goes on.
    """
    record = job / "benchmark_command.json"
    if (job / "metrics.json").is_file() and (job / _SECONDS).is_file():
        if json.loads(record.read_text(encoding="utf-8")) == list(command):
            return
        raise ConfigError(f"{job}: holds another job; give --output another folder, or --name")
    from cfx.plugin import main

    job.mkdir(parents=True, exist_ok=True)
    record.write_text(json.dumps(list(command)), encoding="utf-8")
    began = time.monotonic()
    code = main([*command, files.path_override("hydra.run.dir", job.absolute())])
    if code == 130:
        raise KeyboardInterrupt
    if code == 143:
        raise Terminated
    if code:
        raise DataError("cfx benchmark: the job failed; its words stand above")
    (job / _SECONDS).write_text(f"{time.monotonic() - began:.1f}", encoding="utf-8")


def as_file_name(name: str) -> str:
    """Returns what a row's folder is called."""
    return re.sub(r"[^A-Za-z0-9._=-]+", "-", name).strip("-")
