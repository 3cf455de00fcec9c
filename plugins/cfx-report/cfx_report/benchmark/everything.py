"""Every row of the documentation's tables, one process after the other."""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Iterator
from typing import cast

import cfx
from cfx.errors import ConfigError
from cfx.plugin import registry
from cfx_report.benchmark.rival import Rival

_CONSTANTS = ("idm", "gipps", "ovm", "fvdm", "newell", "w99", "krauss")
"""Models whose parameters are pooled over all drivers, by the default search."""

_POLICIES = (
    ("model=idm", "--method", "closed_loop"),
    ("model=krauss", "--method", "closed_loop"),
    ("experiment=every_road", "protocol.history=null"),
)

_SEEDS = (0, 1)
"""Of rows that are trained: one seed says too little."""


def commands(options: argparse.Namespace) -> Iterator[list[str]]:
    """Yields the command line of each row, the cheap ones first."""
    where = ["--suite", options.suite, "--data", options.data]
    if options.quick:
        where.append("--quick")
    if options.other_data:
        where.append("--other-data")
    for model in _CONSTANTS:
        yield [f"model={model}", *where]
    trained = []
    for entry in registry.entries("rival"):
        rival = cast("type[Rival]", cfx.get("rival", entry.name))
        if rival.trains:
            trained.append([f"rival={entry.name}"])
        else:
            yield [f"rival={entry.name}", *where]
    for words in [*trained, *map(list, _POLICIES)]:
        for seed in _SEEDS if options.suite != "i80" else (0,):
            yield [*words, *where, "--seed", str(seed)]


def run_all(options: argparse.Namespace) -> int:
    """Runs every row in a process of its own; finished ones are not run again.

    Returns:
        0; 1 where a row failed, whose words stand above.

    Raises:
        ConfigError: a single row is asked for too.
    """
    if options.overrides or options.submission or options.name or options.output:
        raise ConfigError("--all makes every row under its own name; leave the others out")
    failed = []
    for words in commands(options):
        print(f"\n== cfx benchmark {' '.join(words)}", flush=True)
        done = subprocess.run(  # noqa: S603 - this program itself
            [sys.executable, "-m", "cfx", "benchmark", *words], check=False
        )
        if done.returncode < 0 or done.returncode in {130, 143}:
            return 130 if done.returncode in {-2, 130} else 143
        if done.returncode:
            failed.append(words[0])
    if failed:
        print(f"\nFailed: {', '.join(failed)}; the others are done.", flush=True)
    return int(bool(failed))
