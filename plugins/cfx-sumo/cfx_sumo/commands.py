"""The sub-command `cfx drive`; what it needs is imported when it runs."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from cfx.errors import ConfigError
from cfx.plugin import Command


class DriveCommand(Command):
    """Runs a SUMO scenario in which policies drive the vehicles of some vTypes."""

    summary = "run a SUMO scenario in which policies drive the vehicles of some types"

    def parser(self) -> argparse.ArgumentParser:
        parser = argparse.ArgumentParser(
            "cfx drive",
            description="Runs a SUMO scenario in which policies drive the vehicles of some vTypes.",
            epilog="What follows -- goes to SUMO as it is:"
            " cfx drive city.sumocfg --drivers calm=RUN -- --time-to-teleport -1",
        )
        parser.add_argument(
            "scenario",
            nargs="?",
            default="ring",
            help="SUMO's configuration (.sumocfg), or a scenario that comes with cfx: ring"
            " (default), motorway, town, stress",
        )
        parser.add_argument(
            "--drivers",
            nargs="+",
            default=["car=cfx://idm"],
            metavar="TYPE=RUN",
            help="a vType, and who drives it: a job, a ready-made policy (cfx policies lists them),"
            " or RUN#NETWORK for one of its networks; default: car=cfx://idm",
        )
        parser.add_argument("--gui", action="store_true", help="show SUMO's window")
        parser.add_argument(
            "--end",
            type=float,
            metavar="SECONDS",
            help="of simulated time; default: the scenario's",
        )
        parser.add_argument(
            "--step",
            type=float,
            metavar="SECONDS",
            help="of the simulation, 0.01 to 1; default: the scenario's, or the policy's where it"
            " has none",
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
            "--report",
            metavar="FOLDER",
            help="flows, headways and time-space diagrams, beside those of SUMO's own models in the"
            " same scenario, which is run once more for it",
        )
        parser.add_argument(
            "--look-ahead",
            type=float,
            default=200.0,
            metavar="METRES",
            help="farther is no leader: the policy's own model drives freely; default: 200",
        )
        parser.add_argument(
            "--speed-mode",
            type=int,
            default=31,
            help="SUMO's bit set; 31 (default): SUMO's own checks bound each speed; 0: none, exact",
        )
        parser.add_argument(
            "--average",
            action="store_true",
            help="all vehicles of a policy have one average driver; otherwise each draws one of the"
            " recorded drivers that the policy learned from, by its id and the seed",
        )
        parser.add_argument(
            "--traffic",
            metavar="FOLDER",
            help="stress: measure the traffic that the driver makes, in place of single events;"
            " tables and a figure go to FOLDER. At --step, or at 0.1, 0.5 and 1 s",
        )
        parser.add_argument(
            "--recorded",
            default="human",
            metavar="WHOSE",
            help="whose flows stand beside those of --traffic: human (default), acc, or a file that"
            " cfx data flows wrote",
        )
        return parser

    def parse(self, arguments: Sequence[str]) -> argparse.Namespace:
        """Reads what stands before `--`; what follows it is SUMO's."""
        given = list(arguments)
        cut = len(given)
        if "--" in given:
            cut = given.index("--")
        options = self.parser().parse_args(given[:cut])
        options.sumo_options = given[cut + 1 :]
        return options

    def run(self, options: argparse.Namespace) -> int:
        _drive(options)
        return 0


def _drive(options: argparse.Namespace) -> None:
    """Runs the scenario in this process and prints what happened.

    Raises:
        CfxError: whatever `cfx_sumo.drive.run.run_scenario` raises.
    """
    from cfx_sumo.installed import require_sumo

    if options.traffic is None:
        require_sumo()
    elif options.scenario != "stress":
        raise ConfigError(
            f"--traffic belongs to the scenario stress, not to {options.scenario}: cfx drive stress"
            " --traffic FOLDER"
        )
    # libsumo does not get on with pyarrow, and pandas loads it where it finds it: this process does
    # without.
    # None is Python's own way to say that a module is not there.
    sys.modules.setdefault("pyarrow", None)  # type: ignore[arg-type]
    from cfx.plugin import console
    from cfx_sumo.drive.printed import report
    from cfx_sumo.drive.run import run_scenario
    from cfx_sumo.drive.scenarios import SCENARIOS

    if options.step is not None and not 0.01 <= options.step <= 1:
        raise ConfigError(f"--step {options.step:g}: give 0.01 to 1 s")
    output = None
    if options.output:
        output = Path(options.output).expanduser()
    report_to = None
    if options.report:
        report_to = Path(options.report).expanduser()
    with console.console_logging():
        runs = parse_drivers(options.drivers)
        if options.traffic is not None:
            _measure_traffic(options, runs)
            return
        if options.scenario == "stress":
            from cfx_sumo.drive.stress import report_stress, run_stress

            result = run_stress(
                runs,
                seed=options.seed or 0,
                speed_mode=options.speed_mode,
                step=options.step,
                sumo_options=options.sumo_options,
            )
            report_stress(result, output)
            return
        scenario = options.scenario
        if scenario not in SCENARIOS:
            scenario = Path(scenario).expanduser()
        run = run_scenario(
            scenario,
            runs,
            end=options.end,
            step=options.step,
            seed=options.seed,
            output=output,
            report_to=report_to,
            look_ahead=options.look_ahead,
            average=options.average,
            speed_mode=options.speed_mode,
            gui=options.gui,
            sumo_options=options.sumo_options,
        )
        report(run)
        if report_to is not None:
            print(f"Flows, headways and diagrams: {report_to}")


def _measure_traffic(options: argparse.Namespace, runs: dict[str, str]) -> None:
    """Measures the traffic of a driver; prints it, and writes it into a folder.

    Raises:
        ConfigError: the scenario is not `stress`.
        CfxError: whatever `cfx_sumo.drive.traffic.measure_traffic` raises.
    """
    from cfx_sumo.drive.traffic import (
        STEPS_S,
        check_alone,
        measure_traffic,
        print_traffic,
        write_traffic,
    )

    steps = STEPS_S if options.step is None else (options.step,)
    report = measure_traffic(
        check_alone(runs),
        recorded=options.recorded,
        steps=steps,
        seed=options.seed or 0,
        sumo_options=options.sumo_options,
    )
    print_traffic(report)
    folder = Path(options.traffic).expanduser()
    words = ["cfx", "drive", "stress", "--drivers", *options.drivers]
    if options.recorded != "human":
        words += ["--recorded", options.recorded]
    if options.step is not None:
        words += ["--step", f"{options.step:g}"]
    words += ["--traffic", "FOLDER"]
    write_traffic(report, folder, shlex.join(words))
    print(f"Tables and figure: {folder}")


def parse_drivers(arguments: Sequence[str]) -> dict[str, str]:
    """Reads `TYPE=RUN` arguments.

    Raises:
        ConfigError: one is not of this form, or names a vType twice.
    """
    runs: dict[str, str] = {}
    for argument in arguments:
        name, equals, run = argument.partition("=")
        if not (name and equals and run):
            raise ConfigError(
                f"--drivers {argument}: write TYPE=RUN, a vType of the scenario and a job's output"
                " folder or a ready-made policy, such as car=cfx://idm"
            )
        if name in runs:
            raise ConfigError(f"--drivers: vType '{name}' stands twice")
        runs[name] = run
    return runs
