"""The contract of a sub-command: `cfx NAME ...`."""

from __future__ import annotations

import argparse
from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

from cfx.core.component import Component


class Command(Component):
    """Base of every sub-command.

    Its name on the command line is that of its entry point; `NAME.ACTION` is `cfx NAME ACTION`, an
    action that a distribution adds to another's sub-command. `cfx --help` imports cfx's own
    sub-commands and tab completion the one that is typed, so the module imports nothing heavy:
    what `run` needs, it imports itself.

    Attributes:
        summary: one line for `cfx --help`, which prints for a third party's sub-command the summary
            of its distribution instead.
    """

    kind = "command"
    summary: ClassVar[str] = ""

    @abstractmethod
    def parser(self) -> argparse.ArgumentParser:
        """Returns what the sub-command takes, with a line of help for each argument."""

    def parse(self, arguments: Sequence[str]) -> argparse.Namespace:
        """Reads the command line behind the sub-command's name."""
        return self.parser().parse_args(list(arguments))

    @abstractmethod
    def run(self, options: argparse.Namespace) -> int:
        """Does the work.

        Args:
            options: as `parse` returns them.

        Returns:
            The exit code: 0; 1 where the answer is no.

        Raises:
            CfxError: the user's mistake, in one sentence; the exit code is then 2.
        """


class ExportFormat(ABC):
    """Base of every format of `cfx export`, which goes by the name of its entry point.

    One is made without arguments for each call of the command.
    """

    @abstractmethod
    def write(self, run: str, output: Path | None) -> list[str]:
        """Writes a job's drivers for another program.

        Args:
            run: as the user names it: a job's folder, its URL, the id of its MLflow run, or
                `cfx://NAME`.
            output: the file; None: the format's own name for it.

        Returns:
            Sentences for the user.

        Raises:
            CfxError: the job cannot be read, or not be written in this format.
        """
