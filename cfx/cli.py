"""The command line: `cfx` and `python -m cfx`.

The sub-commands in `COMMANDS` are plain programs; everything else goes to the Hydra application.
Nothing heavy is imported here.
"""

from __future__ import annotations

import argparse
import gc
import io
import os
import sys
from collections.abc import Sequence
from typing import NoReturn

from cfx.errors import CfxError, Terminated
from cfx.signals import ignore_signals, terminable

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
    _print_anything()
    command = None
    if arguments:
        command = COMMANDS.get(arguments[0])
    try:
        with terminable():
            if command is None:
                return _hydra(arguments)
            return command(arguments[1:])
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


def _hydra(arguments: Sequence[str]) -> int:
    """Runs the Hydra application, or completes what a shell asks for."""

    def start() -> int:
        from cfx import application

        return application.start(arguments)

    from cfx import completion

    if completion.is_query(arguments):
        return completion.answer(PARSERS, start)
    return start()


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
    sys.exit(code)


def _print_anything() -> None:
    r"""Lets terminals that know few letters print the others as `\xe4`, instead of failing."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _plugins_parser() -> argparse.ArgumentParser:
    from cfx.plugins import parser

    return parser()


def _plugins(arguments: Sequence[str]) -> int:
    from cfx.plugins import main as plugins

    return plugins(arguments)


def _policies_parser() -> argparse.ArgumentParser:
    from cfx.publish.command import parser

    return parser()


def _policies(arguments: Sequence[str]) -> int:
    from cfx.publish.command import main as policies

    return policies(arguments)


def _data_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser("cfx data", description="Looks at recordings.")
    actions = parser.add_subparsers(dest="action", required=True)
    describe = actions.add_parser("describe", help="what recordings hold")
    describe.add_argument("files", nargs="+", metavar="FILE")
    fetch = actions.add_parser(
        "fetch", help="download a public recording; nothing else in cfx uses the network unasked"
    )
    fetch.add_argument("recording", choices=["ngsim-i80"], metavar="ngsim-i80")
    fetch.add_argument(
        "--recording",
        dest="part",
        default="0400",
        help="0400 (default), 0500, 0515 (pm, 15 minutes each) or all",
    )
    fetch.add_argument("--folder", default="data", help="where the file goes; default: data")
    fetch.add_argument("--url", help="of a mirror that speaks SODA, ending in .csv")
    fetch.add_argument("--force", action="store_true", help="download again and replace the file")
    return parser


def _data(arguments: Sequence[str]) -> int:
    options = _data_parser().parse_args(list(arguments))
    if options.action == "fetch":
        return _fetch(options)
    from pathlib import Path

    from cfx.datasets.describe import describe as describe_file

    for number, file in enumerate(options.files):
        if number:
            print()
        print(describe_file(Path(file)))
    return 0


def _fetch(options: argparse.Namespace) -> int:
    import shlex
    from pathlib import Path

    from cfx.console import console_logging
    from cfx.datasets.fetch import URL, fetch_ngsim_i80

    with console_logging():
        path = fetch_ngsim_i80(
            Path(options.folder).expanduser(),
            options.part,
            url=options.url or URL,
            force=options.force,
        )
    print(f"Look at it: python -m cfx data describe {shlex.quote(str(path))}")
    print(f"Use it: python -m cfx data=ngsim data.path={shlex.quote(str(path))}")
    return 0


def _benchmark_parser() -> argparse.ArgumentParser:
    from cfx.benchmark.command import parser

    return parser()


def _benchmark(arguments: Sequence[str]) -> int:
    from cfx.benchmark.command import main as benchmark

    return benchmark(arguments)


def _ui_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        "cfx ui", description="Opens the tracked jobs in MLflow, on this machine only."
    )
    parser.add_argument(
        "--uri", help="tracking store; default: MLFLOW_TRACKING_URI, or SQLite beside the outputs"
    )
    parser.add_argument("--port", type=int, default=5000)
    parser.add_argument("--open", action="store_true", help="open the first page in the browser")
    return parser


def _ui(arguments: Sequence[str]) -> int:
    options = _ui_parser().parse_args(list(arguments))
    from cfx.ui import serve

    serve(options.uri, options.port, open_browser=options.open)
    return 0


def _report_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        "cfx report", description="Writes one HTML page about finished jobs, complete in itself."
    )
    parser.add_argument(
        "runs",
        nargs="+",
        metavar="RUN",
        help="output folder of a job or a sweep, its URL (output.url), or id of an MLflow run",
    )
    parser.add_argument(
        "--output",
        metavar="FILE",
        help="default: report.html in the folder; for several, a URL or a run: here",
    )
    parser.add_argument("--title", help="of the page")
    parser.add_argument(
        "--tables", choices=["latex", "csv"], help="write the table of a paper instead of the page"
    )
    parser.add_argument(
        "--group-by",
        metavar="SETTING",
        help="with --tables: jobs that differ in this setting alone, for instance seed, share a row"
        " with mean and standard deviation",
    )
    return parser


def _report(arguments: Sequence[str]) -> int:
    options = _report_parser().parse_args(list(arguments))
    from cfx.report.command import report

    chosen = {"tables": options.tables, "group_by": options.group_by}
    for line in report(options.runs, options.output, options.title, **chosen):
        print(line)
    return 0


def _drive_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        "cfx drive",
        description="Runs a SUMO scenario in which policies drive the vehicles of some vTypes.",
        epilog="What follows -- goes to SUMO as it is:"
        " cfx drive city.sumocfg --drivers calm=RUN -- --step-length 0.1",
    )
    parser.add_argument(
        "scenario",
        nargs="?",
        default="ring",
        help="SUMO's configuration (.sumocfg), or a scenario that comes with cfx: ring (default),"
        " motorway, stress",
    )
    parser.add_argument(
        "--drivers",
        nargs="+",
        default=["car=cfx://i80-idm"],
        metavar="TYPE=RUN",
        help="a vType, and who drives it: a job, a ready-made policy (cfx policies lists them), or"
        " RUN#NETWORK for one of its networks; default: car=cfx://i80-idm",
    )
    parser.add_argument("--gui", action="store_true", help="show SUMO's window")
    parser.add_argument(
        "--end", type=float, metavar="SECONDS", help="of simulated time; default: the scenario's"
    )
    parser.add_argument(
        "--seed",
        type=int,
        help="SUMO's, and that of stochastic policies; default: the scenario's, and 0",
    )
    parser.add_argument(
        "--output",
        metavar="FILE",
        help="CSV: where each driven vehicle is at each step, and its parameters",
    )
    parser.add_argument(
        "--look-ahead",
        type=float,
        default=200.0,
        metavar="METRES",
        help="farther is no leader; default: 200",
    )
    parser.add_argument(
        "--speed-mode",
        type=int,
        default=31,
        help="SUMO's bit set; 31 (default): lights, stops and junctions are obeyed, SUMO's safe gap"
        " is kept; 0: none of it, what the model says to the last bits",
    )
    return parser


def _drive(arguments: Sequence[str]) -> int:
    given = list(arguments)
    cut = len(given)
    if "--" in given:
        cut = given.index("--")
    options = _drive_parser().parse_args(given[:cut])
    from cfx.sumo.command import drive_scenario

    drive_scenario(options, given[cut + 1 :])
    return 0


def _export_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        "cfx export", description="Writes a job's fixed parameters for another program."
    )
    parser.add_argument(
        "run",
        metavar="RUN",
        help="output folder of a job, its URL (output.url), or id of its MLflow run",
    )
    parser.add_argument(
        "--to",
        choices=["sumo"],
        required=True,
        help="sumo: a vType distribution for each cluster (.add.xml)",
    )
    parser.add_argument(
        "--output",
        metavar="FILE",
        help="default: drivers.add.xml in the job's folder; for a URL or an MLflow run: here",
    )
    return parser


def _export(arguments: Sequence[str]) -> int:
    options = _export_parser().parse_args(list(arguments))
    from cfx.sumo.export import export

    for line in export(options.run, options.output):
        print(line)
    return 0


def _cite_parser() -> argparse.ArgumentParser:
    return argparse.ArgumentParser("cfx cite", description="Prints how to cite cfx, as BibTeX.")


def _cite(arguments: Sequence[str]) -> int:
    _cite_parser().parse_args(list(arguments))
    from cfx.cite import bibtex

    print(bibtex())
    return 0


COMMANDS = {
    "plugins": _plugins,
    "policies": _policies,
    "data": _data,
    "benchmark": _benchmark,
    "report": _report,
    "ui": _ui,
    "drive": _drive,
    "export": _export,
    "cite": _cite,
}
"""The sub-commands, by name; whatever else comes first on the command line is Hydra's."""

PARSERS = {
    "plugins": _plugins_parser,
    "policies": _policies_parser,
    "data": _data_parser,
    "benchmark": _benchmark_parser,
    "report": _report_parser,
    "ui": _ui_parser,
    "drive": _drive_parser,
    "export": _export_parser,
    "cite": _cite_parser,
}
"""What each sub-command takes, for completion."""
