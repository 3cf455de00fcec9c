"""Console output: messages of a job, coloured by level on a terminal, and tables."""

from __future__ import annotations

import contextlib
import logging
import sys
from typing import TYPE_CHECKING

from cfx.errors import printable, without_passwords

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rich.table import Table

__all__ = [
    "blank_table",
    "console_logging",
    "print_table",
]
"""What plugins may use, as `cfx.plugin.console`."""


class ConsoleHandler(logging.Handler):
    """Prints messages of cfx, of packages named `cfx_...` and of Hydra, and warnings of everybody.

    Warnings and errors go to stderr, the rest to stdout. The streams are looked up at each message,
    so that a progress bar or a notebook that replaces them is respected.
    """

    def emit(self, record: logging.LogRecord) -> None:
        try:
            package = record.name.partition(".")[0]
            ours = package in {"cfx", "hydra", "hydra_plugins"} or package.startswith("cfx_")
            wanted = (
                ours
                or record.levelno >= logging.WARNING
                or logging.getLogger().isEnabledFor(logging.DEBUG)
            )
            if wanted and not getattr(record, "file_only", False):
                _say(self.format(record), record.levelno)
        except Exception:  # logging's own rule: a handler never raises
            self.handleError(record)


@contextlib.contextmanager
def console_logging(name: str = "cfx", handler: logging.Handler | None = None) -> Iterator[None]:
    """Prints cfx's own messages while a sub-command runs; jobs have their logging from Hydra.

    Args:
        name: of the package or module whose messages are printed.
        handler: takes them in place of the console, such as a file.
    """
    logger = logging.getLogger(name)
    handler = handler or ConsoleHandler()
    level = logger.level
    logger.addHandler(handler)
    logger.setLevel(min(level or logging.INFO, logging.INFO))
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(level)
        handler.close()


def _say(message: str, level: int) -> None:
    message = printable(without_passwords(message))
    stream = sys.stdout
    if level >= logging.WARNING:
        stream = sys.stderr
    if not stream.isatty():
        print(message, file=stream, flush=True)
        return
    from rich.console import Console

    style = None
    if level >= logging.ERROR:
        style = "red"
    elif level >= logging.WARNING:
        style = "yellow"
    Console(file=stream).print(message, style=style, markup=False, highlight=False, soft_wrap=True)


def blank_table(*columns: str, title: str | None = None) -> Table:
    """Returns a table with these columns and no rows."""
    from rich import box
    from rich.table import Table

    made = Table(box=box.SIMPLE_HEAD, title=title, title_justify="left")
    for column in columns:
        made.add_column(column, overflow="fold")
    return made


def print_table(table: Table) -> None:
    """Prints a table; in a file or a pipe nothing is folded, so that lines stay whole for grep."""
    from rich.console import Console

    width = None
    if not sys.stdout.isatty():
        width = 400
    Console(width=width, markup=False).print(table)
