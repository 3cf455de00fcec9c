"""A sub-command. `cfx gains` prints the policy's improvement in each of some finished jobs.

The command line calls `parser` for help and completion, which must answer at once, and `run` when
somebody types it. What takes long to import is therefore imported in `run`.
"""

from __future__ import annotations

import argparse

from cfx.plugin import Command

IMPROVEMENT = "improvement/rmse_speed/driver_specific/geometric"


class Gains(Command):
    """Prints how much smaller the policy's errors are, a line for each job."""

    summary = "how much each of some jobs improves on constant parameters"

    def parser(self) -> argparse.ArgumentParser:
        parser = argparse.ArgumentParser("cfx gains", description=f"Prints {self.summary}.")
        parser.add_argument("jobs", nargs="+", metavar="JOB", help="output folder of a job")
        parser.add_argument("--digits", type=int, default=1, help="after the point; default: 1")
        return parser

    def run(self, options: argparse.Namespace) -> int:
        import cfx

        for job in options.jobs:
            improvement = cfx.load(job).metrics.get(IMPROVEMENT)
            if improvement is None:
                print(f"{job}: no policy was tested")
            else:
                print(f"{job}: {improvement:+.{options.digits}%}")
        return 0
