"""The contract of a sub-command, statement by statement. Nothing of what it does is done."""

from __future__ import annotations

import argparse
import contextlib
import io
import subprocess
import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING

from cfx.core.contract import NotApplicable
from cfx_contracts import contract_of

if TYPE_CHECKING:
    from cfx.core.command import Command

LONGEST = 100
"""Characters of a summary, which stands on one line of `cfx --help`."""

_HEAVY = ("torch", "pandas", "scipy", "matplotlib", "plotly", "lightning", "mlflow")


def it_has_a_summary_of_one_line(command: Command) -> None:
    summary = command.summary
    assert summary.strip(), "`summary` is the line of `cfx --help` about the sub-command"
    assert len(summary.splitlines()) == 1, "`summary` is one line"
    assert len(summary) <= LONGEST, f"`summary` has at most {LONGEST} characters"


def every_argument_has_help(command: Command) -> None:
    bare = [action.dest for action in _actions(command.parser()) if not action.help]
    assert not bare, f"each argument says what it is, in `help=`; {', '.join(bare)} does not"


def help_can_be_printed(command: Command) -> None:
    code, printed = _ended(command, "--help")
    assert code == 0, f"--help ends with the exit code 0, not {code}"
    assert "cfx " in printed, "the parser's `prog` is `cfx NAME`, which --help prints"


def an_unknown_option_is_refused(command: Command) -> None:
    code, _ = _ended(command, "--no-such-option")
    assert code == 2, (
        "an option that there is not is the user's mistake, exit code 2: it must not be ignored"
    )


def its_module_imports_nothing_heavy(command: Command) -> None:
    module = type(command).__module__
    script = (
        f"import sys, importlib\ntry:\n    importlib.import_module({module!r})\n"
        f"except ImportError:\n    sys.exit(3)\nprint(*(sys.modules.keys() & set({_HEAVY!r})))"
    )
    # Our own script, no shell.
    done = subprocess.run(  # noqa: S603
        [sys.executable, "-c", script], capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise NotApplicable(f"{module} is no module that another process can import")
    assert not done.stdout.strip(), (
        f"tab completion imports the module, so that it must be light: import"
        f" {done.stdout.strip()} in `run`"
    )


def _actions(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    """Yields the arguments of a parser and of its sub-parsers."""
    for action in parser._actions:  # noqa: SLF001 - argparse shows them in no other way
        if isinstance(action, argparse._SubParsersAction):  # noqa: SLF001
            for further in action.choices.values():
                yield from _actions(further)
        else:
            yield action


def _ended(command: Command, argument: str) -> tuple[object, str]:
    """Returns the exit code with which an argument ends the parser, and what it prints."""
    said = io.StringIO()
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            command.parse([argument])
    except SystemExit as ended:
        return ended.code, said.getvalue()
    return None, said.getvalue()


CONTRACT = contract_of(__name__, "command", slow=(its_module_imports_nothing_heavy,))
