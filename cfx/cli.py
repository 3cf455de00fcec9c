"""The command line: `cfx` and `python -m cfx`.

`plugins`, `data` and `ui` are plain sub-commands; everything else goes to the Hydra application. Nothing heavy is imported here.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from cfx.errors import CfxError

if TYPE_CHECKING:
    from rich.table import Table


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the program; returns its exit code: 0; 2 for a user's mistake; 1 for a bug; 130 after Ctrl-C; 143 after SIGTERM."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    command = _COMMANDS.get(arguments[0]) if arguments else None
    try:
        if command is None:
            from cfx.application import start

            return start(arguments)
        return command(arguments[1:])
    except CfxError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:  # `cfx plugins | head`: the reader has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


def _plugins(arguments: Sequence[str]) -> int:
    parser = argparse.ArgumentParser("cfx plugins", description="Shows the installed components.")
    actions = parser.add_subparsers(dest="action")
    actions.add_parser("check", help="load every component; exit code 1 if one is broken")
    show = actions.add_parser("show", help="a component's parameters, settings and reference")
    show.add_argument("kind", help="dataset, model, policy, optimizer, learner or protocol")
    show.add_argument("name")
    options = parser.parse_args(list(arguments))
    if options.action == "show":
        return _show(options.kind, options.name)
    return _list(load=options.action == "check")


def _list(*, load: bool) -> int:
    from cfx import registry

    table = _table("kind", "name", "distribution", "version", "from", "state")
    complaints = []
    for kind in registry.KINDS:
        entries = registry.entries(kind)
        for entry in entries:
            complaint = _complaint(kind, entry.name) if load else ""
            twice = sum(one.name == entry.name for one in entries) > 1
            state = "broken" if complaint else "named twice" if twice else "loaded" if registry.is_loaded(entry) else "not loaded"
            table.add_row(kind, entry.name, entry.distribution, entry.version, entry.location, state)
            complaints += [complaint] if complaint else []
    _print(table)
    for complaint in dict.fromkeys(complaints):
        print(complaint, file=sys.stderr)
    return 1 if complaints else 0


def _complaint(kind: str, name: str) -> str:
    """Loads a component and writes its config node; returns what is wrong with it, "" if nothing is."""
    from cfx import nodes, registry

    try:
        nodes.render(registry.get(kind, name), name)
    except CfxError as error:
        return str(error)
    except Exception as error:  # a plugin's schema may raise anything when its defaults are asked for
        return f"{registry.entry(kind, name)} has no config node: {type(error).__name__}: {error}"
    return ""


def _show(kind: str, name: str) -> int:
    import inspect

    from cfx import registry

    entry = registry.entry(kind, name)
    cls: Any = registry.get(kind, name)
    print(f"{entry}\n{entry.location}\n\n{inspect.getdoc(cls) or ''}\n")
    if getattr(cls, "reference", ""):
        print(f"Reference: {cls.reference}\n")
    if hasattr(cls, "parameters"):
        table = _table("parameter", "unit", "low", "high", "default", "tuned", "meaning", "source", title="Parameters")
        for p in cls.parameters:
            tuned = "yes" if p.tuned else "constant"
            table.add_row(p.name, p.unit, f"{p.low:g}", f"{p.high:g}", f"{p.default:g}", tuned, p.meaning, p.source)
        _print(table)
    table = _table("setting", "default", "meaning", title=f"Settings (set with {registry.kind_of(kind).group}.SETTING=VALUE)")
    for field_name, field in cls.schema.model_fields.items():
        default = "required" if field.is_required() else repr(field.get_default(call_default_factory=True, validated_data={}))
        table.add_row(field_name, default, field.description or "")
    _print(table)
    return 0


def _data(arguments: Sequence[str]) -> int:
    parser = argparse.ArgumentParser("cfx data", description="Looks at recordings.")
    describe = parser.add_subparsers(dest="action", required=True).add_parser("describe", help="what a recording holds")
    describe.add_argument("file")
    options = parser.parse_args(list(arguments))
    from pathlib import Path

    from cfx.datasets.describe import describe as describe_file

    print(describe_file(Path(options.file)))
    return 0


def _ui(arguments: Sequence[str]) -> int:
    parser = argparse.ArgumentParser("cfx ui", description="Opens the tracked jobs in MLflow, on this machine only.")
    parser.add_argument("--uri", help="tracking store; default: MLFLOW_TRACKING_URI, or SQLite beside the outputs")
    parser.add_argument("--port", type=int, default=5000)
    options = parser.parse_args(list(arguments))
    from cfx.ui import serve

    serve(options.uri, options.port)
    return 0


_COMMANDS = {"plugins": _plugins, "data": _data, "ui": _ui}


def _table(*columns: str, title: str | None = None) -> Table:
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, title=title, title_justify="left")
    for column in columns:
        table.add_column(column, overflow="fold")
    return table


def _print(table: Table) -> None:
    from rich.console import Console

    # In a file or a pipe nothing is folded: lines stay whole for grep.
    Console(width=None if sys.stdout.isatty() else 400, markup=False).print(table)
