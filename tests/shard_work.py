"""What made-up shards do; a module, so that workers can import it."""

from __future__ import annotations

import os
import time
from pathlib import Path

from cfx.core.engine import Report, Unfit


def slowly(shard: tuple[int, float], report: Report) -> int:
    """Takes some seconds, and squares the number."""
    number, seconds = shard
    time.sleep(seconds)
    report(1)
    return number * number


def where(shard: tuple[int, Path], report: Report) -> str:
    """Writes into a folder if the worker has one of its own; returns the worker's name."""
    report(1)
    own = os.environ.get("CFX_TEST_DISK")
    if own is not None:
        Path(own, f"{shard[0]}").write_bytes(b"x" * 65536)
    return os.environ.get("CFX_TEST_WORKER", "")


def only_on_good(shard: int, report: Report) -> str:
    name = os.environ.get("CFX_TEST_WORKER", "")
    if name != "good":
        raise Unfit("this worker has no compiler")
    report(1)
    return name


def dies(_shard: int, _report: Report) -> None:
    """Kills its worker, always."""
    os.kill(os.getpid(), 9)
