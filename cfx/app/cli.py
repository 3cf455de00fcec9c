"""The command line: `cfx` and `python -m cfx`.

A first word that is no `key=value` names a sub-command, an entry point of the group `cfx.commands`;
everything else goes to the Hydra application. Nothing heavy is imported here.
"""

from __future__ import annotations

import gc
import io
import os
import re
import sys
import traceback
from collections.abc import Sequence
from typing import TYPE_CHECKING, NoReturn, cast

from cfx.core.processes import ignore_signals, raise_if_signalled, signal_behind, terminable
from cfx.errors import CfxError, ConfigError, Terminated

if TYPE_CHECKING:
    from cfx.core.command import Command

_GC_THRESHOLD = 100_000
"""Objects after which Python looks for cycles; its own 700 costs a tenth of the time of imports."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the program.

    Returns:
        The exit code: 0; 2 for a user's mistake; 1 for a bug; 130 after Ctrl-C; 143 after SIGTERM.
    """
    if argv is None:
        argv = sys.argv[1:]
    arguments = list(argv)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # letters that it does not know become `\xe4`
            stream.reconfigure(errors="backslashreplace")
    try:
        with terminable():
            try:
                code = _run(arguments)
            except Exception as error:
                signalled = signal_behind(error)
                if signalled is not None:
                    raise signalled from error
                raise
            if code == 1:
                raise_if_signalled()
            return code
    except CfxError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        return 130
    except Terminated:
        return 143
    except BrokenPipeError:  # `cfx plugins | head`: the reader has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


def _run(arguments: Sequence[str]) -> int:
    """Runs a sub-command or the Hydra application; returns the exit code."""
    if list(arguments) == ["--version"]:
        import cfx

        print(f"cfx {cfx.__version__}")
        return 0
    if arguments and re.match(r"\w[^=]*$", arguments[0]):
        return _command(*arguments)
    if _is_completion(arguments):
        from cfx.app import completion

        return completion.answer(arguments)
    from cfx.app import application

    # Hydra knows no `--verbose`: it is a setting.
    settings = []
    for word in arguments:
        if word == "--verbose":
            settings.append("output.verbose=true")
        else:
            settings.append(word)
    return application.start(settings)


def _command(name: str, *arguments: str) -> int:
    """Runs a sub-command: `NAME`, or `NAME.ACTION` where that is one of its own.

    Raises:
        ConfigError: there is none of that name.
        PluginError: it cannot be loaded, two distributions claim its name, or its code failed.
    """
    from cfx.core import registry
    from cfx.core.distributions import brought

    action = ".".join((name, *arguments[:1]))
    if action in registry.names("command") or ("command", action) in brought():
        name, arguments = action, arguments[1:]
    if name not in registry.names("command"):
        from cfx.app.user_errors import no_command

        raise ConfigError(no_command(name))
    command = cast("Command", registry.create("command", {"name": name}))
    try:
        return command.run(command.parse(arguments))
    except (CfxError, OSError):
        raise
    except Exception as error:
        from cfx.core.registry import blame

        blamed = blame(error, "CFX_TRACEBACK=1 shows the whole traceback")
        if blamed is None:
            raise
        if os.environ.get("CFX_TRACEBACK", "") not in {"", "0"}:
            traceback.print_exception(error)
        raise blamed from error


def _is_completion(arguments: Sequence[str]) -> bool:
    """Says whether a shell asks for completions: `-sc query=bash`."""
    asks = len(arguments) == 2 and arguments[0] in {"-sc", "--shell-completion"}
    return asks and arguments[1].startswith("query=")


def program() -> NoReturn:
    """Runs the program and ends the process; a signal that comes too late changes nothing.

    Raises:
        SystemExit: always, with the exit code.
    """
    gc.set_threshold(_GC_THRESHOLD)
    try:
        code = main()
    except KeyboardInterrupt:
        code = 130
    ignore_signals()
    # Python looks for cycles in all libraries as it ends, which takes seconds.
    gc.freeze()
    sys.exit(code)
