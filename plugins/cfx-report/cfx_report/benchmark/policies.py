"""The sub-command `cfx policies make`."""

from __future__ import annotations

import argparse
from pathlib import Path

from cfx.plugin import Command
from cfx_report.benchmark.recipes import RECIPES


class MakePolicies(Command):
    """Trains the ready-made policies anew."""

    summary = "train ready-made policies anew and write them into the package"

    def parser(self) -> argparse.ArgumentParser:
        parser = argparse.ArgumentParser(
            "cfx policies make",
            description="Trains ready-made policies anew and writes them into the package.",
        )
        parser.add_argument(
            "names", nargs="*", help=f"of {', '.join(RECIPES)}; all of them if left out"
        )
        parser.add_argument(
            "--data", type=Path, required=True, help="the folder with the recordings"
        )
        parser.add_argument(
            "--work",
            type=Path,
            default=Path("outputs/policies"),
            help="where jobs run; finished ones are not run again",
        )
        return parser

    def run(self, options: argparse.Namespace) -> int:
        from cfx_report.benchmark.publish import make

        make(options.names, options.data, options.work)
        return 0
