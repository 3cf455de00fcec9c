"""Tab completion of the sub-commands; what begins with a group or a key is Hydra's.

Hydra's script for the shell asks the program for words (`cfx -sc query=bash`, the line in the
environment). Where the line begins with a sub-command, argcomplete answers from its parser, in
a tenth of Hydra's time. Nothing is ever printed but words: a message would land in the middle of
what somebody types.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, cast

if TYPE_CHECKING:
    from cfx.core.command import Command


def answer(arguments: Sequence[str]) -> int:
    """Prints the words with which the line may go on; returns the exit code.

    Args:
        arguments: of the program, with which Hydra answers in its turn.
    """
    from cfx.core import registry

    line = os.environ.get("COMP_LINE", "")
    line = line[: int(os.environ.get("COMP_POINT", len(line)))]
    _, _, typed = line.lstrip().partition(" ")
    typed = typed.lstrip()
    command, is_complete, arguments_typed = typed.partition(" ")
    commands = registry.names("command")
    if is_complete and command in commands:
        action, is_action_complete, typed_of_action = arguments_typed.partition(" ")
        if is_action_complete and f"{command}.{action}" in commands:
            print("\n".join(_words_of(f"{command}.{action}", typed_of_action)))
            return 0
        words = _words_of(command, arguments_typed)
        for name in commands:
            if not is_action_complete and name.startswith(f"{command}.{action}"):
                words.append(name.removeprefix(f"{command}."))
        print("\n".join(words))
        return 0
    if not is_complete:
        matching = []
        for name in commands:
            if name.startswith(command) and "." not in name:
                matching.append(name)
        print("\n".join(matching))
        if matching and command:
            return 0
    from cfx.app import application  # takes ten times as long as all of the above

    printed = io.StringIO()
    with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(printed):
        code = application.start(arguments)
    if code == 0:
        print(printed.getvalue())
    return 0


def _words_of(command: str, line: str) -> list[str]:
    """Returns what the last word of a line behind a sub-command may become.

    That is nothing where it is a file, or where the sub-command is a plugin's and broken.
    """
    from argcomplete.completers import SuppressCompleter
    from argcomplete.finders import CompletionFinder

    from cfx.core import registry

    words: list[str] = []
    before = line[: len(line) - len(line.rpartition(" ")[2])]
    with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
        try:
            parser = cast("Command", registry.create("command", {"name": command})).parser()
            finder = CompletionFinder(
                parser, always_complete_options=False, default_completer=SuppressCompleter()
            )
            while (whole := finder.rl_complete(line, len(words))) is not None:
                words.append(whole.removeprefix(before).strip())
        except Exception:  # a plugin may raise anything
            return []
    return words


def complete_with(
    action: argparse.Action, answers: Callable[[argparse.Namespace], Iterable[str]]
) -> None:
    """Lets an argument be completed with what the arguments that stand before it say."""

    def completer(parsed_args: argparse.Namespace, **_: object) -> list[str]:
        return list(answers(parsed_args))

    action.completer = completer  # type: ignore[attr-defined] # where argcomplete looks for it


def add_kind(parser: argparse.ArgumentParser, *, optional: bool = False) -> None:
    """Adds the argument `kind`; it means all kinds if it may be left out."""
    from cfx.core import registry

    about = f"{', '.join(registry.every_kind())} (data is a dataset too)"
    if optional:
        about += "; all kinds if left out"
    action = parser.add_argument("kind", nargs="?" if optional else None, help=about)
    complete_with(action, lambda _: registry.every_kind())
