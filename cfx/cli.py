"""The command line: `cfx` and `python -m cfx`.

`plugins`, `data`, `report` and `ui` are plain sub-commands; everything else goes to the Hydra application. Nothing heavy is
imported here.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence

from cfx.errors import CfxError


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
    from cfx.plugins import main as plugins

    return plugins(arguments)


def _data(arguments: Sequence[str]) -> int:
    parser = argparse.ArgumentParser("cfx data", description="Looks at recordings.")
    actions = parser.add_subparsers(dest="action", required=True)
    describe = actions.add_parser("describe", help="what a recording holds")
    describe.add_argument("file")
    fetch = actions.add_parser("fetch", help="download a public recording; nothing else in cfx uses the network unasked")
    fetch.add_argument("recording", choices=["ngsim-i80"], metavar="ngsim-i80")
    fetch.add_argument("--recording", dest="part", default="0400", help="0400 (default), 0500, 0515 (pm, 15 minutes each) or all")
    fetch.add_argument("--folder", default="data", help="where the file goes; default: data")
    fetch.add_argument("--url", help="of a mirror that speaks SODA, ending in .csv")
    fetch.add_argument("--force", action="store_true", help="download again and replace the file")
    options = parser.parse_args(list(arguments))
    if options.action == "fetch":
        return _fetch(options)
    from pathlib import Path

    from cfx.datasets.describe import describe as describe_file

    print(describe_file(Path(options.file)))
    return 0


def _fetch(options: argparse.Namespace) -> int:
    import logging
    import shlex
    from pathlib import Path

    from cfx.console import ConsoleHandler
    from cfx.datasets.fetch import URL, fetch_ngsim_i80

    logger = logging.getLogger("cfx")
    handler, level = ConsoleHandler(), logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        path = fetch_ngsim_i80(Path(options.folder).expanduser(), options.part, url=options.url or URL, force=options.force)
    finally:
        logger.removeHandler(handler)
        logger.setLevel(level)
    print(f"Look at it: python -m cfx data describe {shlex.quote(str(path))}")
    print(f"Use it: python -m cfx data=ngsim data.path={shlex.quote(str(path))}")
    return 0


def _ui(arguments: Sequence[str]) -> int:
    parser = argparse.ArgumentParser("cfx ui", description="Opens the tracked jobs in MLflow, on this machine only.")
    parser.add_argument("--uri", help="tracking store; default: MLFLOW_TRACKING_URI, or SQLite beside the outputs")
    parser.add_argument("--port", type=int, default=5000)
    parser.add_argument("--open", action="store_true", help="open the first page in the browser")
    options = parser.parse_args(list(arguments))
    from cfx.ui import serve

    serve(options.uri, options.port, open_browser=options.open)
    return 0


def _report(arguments: Sequence[str]) -> int:
    parser = argparse.ArgumentParser("cfx report", description="Writes one HTML page about finished jobs, complete in itself.")
    parser.add_argument("runs", nargs="+", metavar="RUN", help="output folder of a job or a sweep, or id of an MLflow run")
    parser.add_argument("--output", metavar="FILE", help="default: report.html in the folder; for several, or a run: here")
    parser.add_argument("--title", help="of the page")
    options = parser.parse_args(list(arguments))
    from cfx.report.command import report

    for line in report(options.runs, options.output, options.title):
        print(line)
    return 0


_COMMANDS = {"plugins": _plugins, "data": _data, "report": _report, "ui": _ui}
