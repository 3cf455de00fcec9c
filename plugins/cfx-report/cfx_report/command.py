"""`cfx report`: one page, or a paper's table, about finished jobs."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from cfx.errors import ConfigError
from cfx.plugin import Command

NAME = "report.html"


class ReportCommand(Command):
    """Writes one HTML page about finished jobs, or the table of a paper."""

    summary = "one HTML page about finished jobs, to be sent to a colleague"

    def parser(self) -> argparse.ArgumentParser:
        parser = argparse.ArgumentParser(
            "cfx report",
            description="Writes one HTML page about finished jobs, complete in itself.",
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
            "--tables",
            choices=["latex", "csv"],
            help="write the table of a paper instead of the page",
        )
        parser.add_argument(
            "--group-by",
            metavar="SETTING",
            help="with --tables: jobs that differ in this setting alone, for instance seed, share a"
            " row with mean and standard deviation",
        )
        return parser

    def run(self, options: argparse.Namespace) -> int:
        chosen = {"tables": options.tables, "group_by": options.group_by}
        for line in report(options.runs, options.output, options.title, **chosen):
            print(line)
        return 0


def report(
    runs: Sequence[str],
    output: str | None = None,
    title: str | None = None,
    *,
    tables: str | None = None,
    group_by: str | None = None,
) -> list[str]:
    """Writes the report about some jobs; returns what to tell the user.

    Args:
        runs: as `read_runs` takes them.
        output: the file; None for `report.html` (`.tex`, `.csv`) in the only folder that was given,
            else in the current one.
        title: of the page; None for one that names the driving models.
        tables: `latex` or `csv` for the table of a paper instead of the page.
        group_by: as `write_table` takes it.

    Raises:
        ConfigError: `group_by` goes with `tables` alone, or is no setting of these jobs.
        DataError, TrackingError: the jobs cannot be read.
        OutputError: the page cannot be written.
    """
    from cfx.plugin import wording
    from cfx_report.page import write_report
    from cfx_report.paper import FORMS, write_table
    from cfx_report.runs import read_runs

    if group_by is not None and tables is None:
        raise ConfigError(f"--group-by {group_by} goes with --tables latex or --tables csv")
    jobs_of_runs = read_runs(runs)
    folder = Path(runs[0]).expanduser()
    home = folder if len(runs) == 1 and folder.is_dir() else Path()
    kind = "Report"
    if tables is None:
        path = write_report(
            jobs_of_runs, Path(output).expanduser() if output else home / NAME, title
        )
    else:
        kind, name = "Table", Path(NAME).with_suffix(FORMS[tables])
        file = Path(output).expanduser() if output else home / name
        path = write_table(jobs_of_runs, file, tables, group_by)
    left_out = ""
    if jobs_of_runs.unfinished and tables is None:
        left_out = f"; {len(jobs_of_runs.unfinished)} unfinished ones are named in it"
    elif jobs_of_runs.unfinished:
        left_out = f"; {len(jobs_of_runs.unfinished)} unfinished ones are not in it"
    return [
        f"{kind} of {wording.plural(len(jobs_of_runs.jobs), 'job')}{left_out}: {path.absolute()}"
    ]
