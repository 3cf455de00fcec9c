"""`cfx export`: a job's fixed parameters for another program."""

from __future__ import annotations

import argparse

from cfx import Command


class ExportCommand(Command):
    """Writes a job's fixed parameters for another program."""

    summary = "a job's fixed parameters as SUMO's vehicle types"

    def parser(self) -> argparse.ArgumentParser:
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

    def run(self, options: argparse.Namespace) -> int:
        from cfx_sumo.export import export

        for line in export(options.run, options.output):
            print(line)
        return 0
