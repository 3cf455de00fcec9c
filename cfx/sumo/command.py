"""What `cfx drive` does before SUMO and the policies are imported."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from cfx.simulators.sumo.installed import require_sumo


def drive_scenario(options: argparse.Namespace, sumos: Sequence[str]) -> None:
    """Runs the scenario in this process and prints what happened.

    Args:
        options: of the command line.
        sumos: SUMO's own options.

    Raises:
        CfxError: whatever `cfx.sumo.drive.drive` raises.
    """
    require_sumo()
    # libsumo does not get on with pyarrow, and pandas loads it where it finds it: this process does without.
    sys.modules.setdefault("pyarrow", None)  # type: ignore[arg-type]  # Python's own way to say that a module is not there
    from cfx.console import console_logging
    from cfx.sumo.drive import drive, parse_drivers, report

    with console_logging():
        report(
            drive(
                Path(options.scenario).expanduser(),
                parse_drivers(options.drivers),
                end=options.end,
                seed=options.seed,
                output=Path(options.output).expanduser() if options.output else None,
                look_ahead=options.look_ahead,
                speed_mode=options.speed_mode,
                options=sumos,
            )
        )
