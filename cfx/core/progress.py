"""Progress of long work: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import logging
import threading
import time
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

log = logging.getLogger(__name__)

_LINE_EVERY = 15.0
"""Seconds between plain lines."""


class Task:
    """Progress of one part of the work: a context manager whose `advance` the work calls.

    Args:
        description: what is being done, for people.
        total: units of work in all; 0 shows nothing.
        console: where a bar is drawn if it is a terminal; stderr unless given.
    """

    def __init__(self, description: str, total: int, console: Console | None = None) -> None:
        self.description = description
        self.total = total
        self.done = 0
        self._console = console or Console(stderr=True)
        self._bar: Progress | None = None
        self._lock = threading.Lock()
        self._began = self._told = time.monotonic()

    def __enter__(self) -> Self:
        if self.total and self._console.is_terminal:
            columns = (
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TimeElapsedColumn(),
                TimeRemainingColumn(),
            )
            self._bar = Progress(*columns, console=self._console, transient=True)
            self._bar.start()
            self._bar.add_task(self.description, total=self.total)
        return self

    def advance(self, units: int = 1) -> None:
        """Says that `units` more are done; threads may say so at once."""
        with self._lock:
            self._advance(units)

    def _advance(self, units: int) -> None:
        self.done += units
        now = time.monotonic()
        if self._bar is not None:
            self._bar.update(self._bar.task_ids[0], completed=self.done)
        elif self.total and now - self._told >= _LINE_EVERY:
            self._told = now
            log.info(
                "%s: %.0f %% after %.0f s",
                self.description,
                100 * self.done / self.total,
                now - self._began,
            )

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._bar is not None:
            self._bar.stop()
        if self.total and kind is None:
            log.info("%s: done in %.1f s", self.description, time.monotonic() - self._began)
