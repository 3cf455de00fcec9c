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
        CfxError: whatever `cfx.sumo.drive.run_scenario` raises.
    """
    require_sumo()
    # libsumo does not get on with pyarrow, and pandas loads it where it finds it: this process does
    # without.
    # None is Python's own way to say that a module is not there.
    sys.modules.setdefault("pyarrow", None)  # type: ignore[arg-type]
    from cfx.console import console_logging
    from cfx.sumo.drive import parse_drivers, report, run_scenario
    from cfx.sumo.scenarios import SCENARIOS

    output = None
    if options.output:
        output = Path(options.output).expanduser()
    with console_logging():
        runs = parse_drivers(options.drivers)
        if options.scenario == "stress":
            from cfx.sumo.stress import report_stress, run_stress

            result = run_stress(runs, seed=options.seed or 0, speed_mode=options.speed_mode)
            report_stress(result, output)
            return
        scenario = options.scenario
        if scenario not in SCENARIOS:
            scenario = Path(scenario).expanduser()
        run = run_scenario(
            scenario,
            runs,
            end=options.end,
            seed=options.seed,
            output=output,
            look_ahead=options.look_ahead,
            speed_mode=options.speed_mode,
            gui=options.gui,
            options=sumos,
        )
        report(run)
