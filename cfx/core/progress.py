"""Progress of long work: a bar in a notebook or on a terminal, plain lines elsewhere."""

from __future__ import annotations

import html
import logging
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from importlib import import_module
from typing import Any, Self
from uuid import uuid4

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

_DRAW_EVERY = 0.2
"""Seconds between drawings in a notebook, and before the first: short work shows nothing."""

_ON_TERMINALS: ContextVar[bool] = ContextVar("_ON_TERMINALS", default=True)


@contextmanager
def no_bars_on_terminals() -> Iterator[None]:
    """Lets the block draw bars in notebooks alone: a program's terminal is the program's own."""
    before = _ON_TERMINALS.set(False)
    try:
        yield
    finally:
        _ON_TERMINALS.reset(before)


class _TerminalBar:
    """A line at the bottom of a terminal."""

    def __init__(self, description: str, total: int, console: Console) -> None:
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
        )
        progress = Progress(*columns, console=console, transient=True)
        progress.start()
        task = progress.add_task(description, total=total)
        self.draw = lambda done: progress.update(task, completed=done)
        self.close = progress.stop


class _NotebookBar:
    """A bar below a notebook's cell, by IPython alone: rich's and tqdm's need ipywidgets."""

    def __init__(self, description: str, total: int, display: Any) -> None:
        self._description, self._total, self._display = description, total, display
        self._place = uuid4().hex
        self._done, self._is_shown, self._is_closed = 0, False, False
        self._lock = threading.Lock()
        self._began = self._drawn = time.monotonic()
        # Of long work, whose first unit takes long too.
        self._first = threading.Timer(_DRAW_EVERY, self.draw, (0,))
        self._first.daemon = True
        self._first.start()

    def draw(self, done: int) -> None:
        with self._lock:
            self._done = max(self._done, done)
            now = time.monotonic()
            if self._is_closed or now - self._drawn < _DRAW_EVERY:
                return
            self._drawn = now
            progress = f"{100 * self._done / self._total:.0f} % after {now - self._began:.0f} s"
            bar = f'<progress max="{self._total}" value="{self._done}"></progress>'
            self._show(f"<div>{html.escape(self._description)} {bar} {progress}</div>", progress)

    def close(self) -> None:
        self._first.cancel()
        with self._lock:
            self._is_closed = True
            if self._is_shown:
                self._show("", "")

    def _show(self, page: str, text: str) -> None:
        data = {"text/html": page, "text/plain": text}
        self._display(data, raw=True, display_id=self._place, update=self._is_shown)
        self._is_shown = True


def _notebook() -> Any | None:
    """Returns IPython's `display` in a notebook's kernel; None elsewhere."""
    ipython = sys.modules.get("IPython")  # a notebook has imported it
    shell = None if ipython is None else ipython.get_ipython()
    if getattr(shell, "kernel", None) is None:
        return None
    return import_module("IPython.display").display


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
        self._bar: _TerminalBar | _NotebookBar | None = None
        self._lock = threading.Lock()
        self._began = self._told = time.monotonic()

    def __enter__(self) -> Self:
        display = _notebook() if self.total else None
        if display is not None:
            self._bar = _NotebookBar(self.description, self.total, display)
        elif self.total and self._console.is_terminal and _ON_TERMINALS.get():
            self._bar = _TerminalBar(self.description, self.total, self._console)
        return self

    def advance(self, units: int = 1) -> None:
        """Says that `units` more are done; threads may say so at once."""
        with self._lock:
            self.done += units
            now = time.monotonic()
            if self._bar is not None:
                self._bar.draw(self.done)
            elif self.total and now - self._told >= _LINE_EVERY:
                self._told = now
                share = 100 * self.done / self.total
                log.info("%s: %.0f %% after %.0f s", self.description, share, now - self._began)

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()
        if self.total and kind is None:
            log.info("%s: done in %.1f s", self.description, time.monotonic() - self._began)
