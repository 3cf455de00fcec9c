"""`cfx ui`: the tracked jobs in MLflow."""

from __future__ import annotations

import argparse

from cfx.core.command import Command


class UiCommand(Command):
    """Opens the tracked jobs in MLflow."""

    summary = "open the results in MLflow"

    def parser(self) -> argparse.ArgumentParser:
        parser = argparse.ArgumentParser(
            "cfx ui", description="Opens the tracked jobs in MLflow, on this machine only."
        )
        parser.add_argument(
            "--uri",
            help="tracking store; default: MLFLOW_TRACKING_URI, or SQLite beside the outputs",
        )
        parser.add_argument(
            "--port", type=int, default=5000, help="of MLflow's pages; default: 5000"
        )
        parser.add_argument(
            "--open", action="store_true", help="open the first page in the browser"
        )
        return parser

    def run(self, options: argparse.Namespace) -> int:
        from cfx.results.mlflow.serve import serve

        serve(options.uri, options.port, open_browser=options.open)
        return 0
