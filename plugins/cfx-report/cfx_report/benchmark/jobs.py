"""Runs the benchmark's job and writes its row."""

from __future__ import annotations

import json
import re
import shlex
import time
from collections.abc import Sequence
from pathlib import Path
from typing import cast

import cfx
from cfx.errors import ConfigError, DataError, Terminated, nearest
from cfx.plugin import files
from cfx_report.benchmark.frozen import DATA, DATA_NAME, FROZEN_KEYS, METHODS, OVERRIDES
from cfx_report.benchmark.row import PAIRS, ROW, Row, errors_of, protocol_name, values_of

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


def run(
    overrides: Sequence[str], data: Path, folder: Path | None, *, name: str, other_data: bool
) -> tuple[Row, Path]:
    """Runs one job under the frozen protocol and writes its row; a finished job is not run again.

    Args:
        overrides: of the job: its model, policy, learner and what else is a method's own.
        data: the recordings.
        folder: the job's; None: `outputs/benchmark/NAME`.
        name: of the row.
        other_data: whether pairs other than the frozen ones are allowed.

    Returns:
        The row and the job's folder.

    Raises:
        ConfigError: an override changes what is frozen.
        DataError: the pairs are not the frozen ones, or the job failed.
    """
    _require_free(overrides)
    fingerprint = _fingerprint(data)
    if fingerprint != DATA and not other_data:
        raise DataError(
            f"{data}: holds other pairs than the benchmark's ({DATA_NAME}): their fingerprint is"
            f" {fingerprint[:12]} instead of {DATA[:12]}. Errors on other pairs do not compare;"
            " with --other-data the row is made and marked"
        )
    about = DATA_NAME
    if fingerprint != DATA:
        about = f"{data.name}, {fingerprint[:12]}"
    job = folder or Path("outputs/benchmark") / _as_file_name(name)
    command = [*overrides, *OVERRIDES, files.path_override("data.path", data)]
    protocol = protocol_name(fingerprint)
    print(f"Benchmark {protocol}, row '{name}'; the job's folder: {job}", flush=True)
    _run_job(command, job)
    errors = errors_of(job, name, protocol, _method(job))
    row = Row(
        name=name,
        protocol=protocol,
        data=about,
        command=f"cfx benchmark {shlex.join(_of_method(overrides))}",
        cfx=str(json.loads((job / "data.json").read_text(encoding="utf-8"))["cfx"]),
        seconds=float((job / _SECONDS).read_text(encoding="utf-8")),
        pairs=len(errors),
        drivers=errors["driver"].nunique(),
        values=values_of(errors),
    )
    with files.atomic_write(job / PAIRS) as temporary:
        errors.to_csv(temporary, index=False)
    row.write(job / ROW)
    return row, job


def overrides_of(method: str | None, given: Sequence[str]) -> list[str]:
    """Returns a job's overrides: a method's, then what the user gives.

    Raises:
        ConfigError: there is no such method.
    """
    if method is None:
        chooses = {"policy", "learner", "experiment"}
        if any(one.partition("=")[0] in chooses for one in given):
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
    for one in _of_method(given):
        key, _, value = one.partition("=")
        if key in {"model", "policy", "learner", "experiment"}:
            words.append(value)
        else:
            words.append(one)
    if method is not None:
        words.append(method.replace("_", " "))
    elif not any(one.startswith(("policy=", "learner=", "experiment=")) for one in given):
        words.append("constant")
    return ", ".join(words)


def _of_method(overrides: Sequence[str]) -> list[str]:
    """Returns the overrides without those that change no result."""
    kept = []
    for one in overrides:
        if one.partition("=")[0].split(".")[0] not in _CHANGE_NOTHING:
            kept.append(one)
    return kept


def _require_free(overrides: Sequence[str]) -> None:
    """Raises ConfigError for an override of what is frozen."""
    for one in overrides:
        key = one.partition("=")[0].lstrip("+~")
        if key.split(".")[0].split("@")[0] in FROZEN_KEYS:
            raise ConfigError(
                f"cfx benchmark: {one}: pairs, folds, seed, split, windows and metrics are the"
                " benchmark's; without them rows do not compare. A job of your own: python -m cfx"
            )


def _fingerprint(data: Path) -> str:
    """Returns the fingerprint of the pairs that the benchmark takes of a file."""
    cls = cfx.get("dataset", "tidy")
    dataset = cast(cfx.plugin.Dataset, cls(path=data, min_duration=30))
    return dataset.load().fingerprint


def _run_job(command: Sequence[str], job: Path) -> None:
    """Runs a job, unless the same one is finished there.

    Raises:
        ConfigError: the folder holds another job.
        DataError: it failed; its own words stand above.
        KeyboardInterrupt, Terminated: it was broken off; the same command goes on.
    """
    record = job / "benchmark_command.json"
    if (job / "metrics.json").is_file() and (job / _SECONDS).is_file():
        if json.loads(record.read_text(encoding="utf-8")) == list(command):
            print(f"{job}: was finished before")
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


def _method(job: Path) -> str:
    """Returns whose errors count: the policy's, or those of pooled constant parameters."""
    about = json.loads((job / "data.json").read_text(encoding="utf-8"))
    return "pooled" if about["purpose"] == "calibration" else "policy"


def _as_file_name(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9._=-]+", "-", name).strip("-")
