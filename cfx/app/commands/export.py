"""`cfx export`: a job's drivers for another program."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import cast

from cfx.app.completion import complete_with
from cfx.core import registry
from cfx.core.command import Command, ExportFormat


class ExportCommand(Command):
    """Writes a job's drivers for another program."""

    summary = "a job's drivers for other programs: SUMO's vehicle types, an ONNX file"

    def parser(self) -> argparse.ArgumentParser:
        parser = argparse.ArgumentParser(
            "cfx export", description="Writes a job's drivers for another program."
        )
        parser.add_argument(
            "run",
            metavar="RUN",
            help="output folder of a job, its URL (output.url), id of its MLflow run, or a"
            " ready-made policy (cfx://NAME)",
        )
        to = parser.add_argument(
            "--to",
            metavar="FORMAT",
            required=True,
            help="sumo (cfx-sumo): driver-specific parameters, a vType distribution for each"
            " cluster (.add.xml); onnx (cfx-drivers): the policy with its driving model (.onnx);"
            " fmi (cfx-drivers): the same as a co-simulation unit of FMI 3.0 (.fmu); netcdf"
            " (cfx-posteriors): draws of each driver's parameters, for ArviZ (.nc);"
            " RUN#NETWORK for one of its networks",
        )
        complete_with(to, lambda _: registry.names("export"))
        parser.add_argument(
            "--output",
            metavar="FILE",
            help="default: drivers.add.xml, driver.onnx, driver.fmu or posterior.nc in the job's"
            " folder; here, where RUN is no folder",
        )
        return parser

    def run(self, options: argparse.Namespace) -> int:
        output = None
        if options.output:
            output = Path(options.output).expanduser()
        export = cast("type[ExportFormat]", registry.get("export", options.to))()
        for line in export.write(options.run, output):
            print(line)
        return 0
