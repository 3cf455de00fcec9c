"""`cfx drive stress --traffic`: what traffic a driver makes, in a table, a folder and a figure.

What single roads show is simulated without SUMO (`cfx.plugin.traffic`). A light, a lane drop and a
town need SUMO, and are driven at several steps of the simulation: where it is not installed, they
are left out, and it is said.

The town is compared with SUMO's own Krauss with `tau=1.4`: its default of 1 s lets more vehicles
through a light (2,182 an hour of green) than people do.
"""

from __future__ import annotations

import csv
import tempfile
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.text import Text

from cfx.errors import NotInstalledError, OutputError, SumoError
from cfx.plugin import Task, files, traffic
from cfx_sumo.drive.queue import SECONDS, QueueAtLight, queue_of
from cfx_sumo.drive.scenarios import ASSETS, CAR, SCENARIOS, Scenario
from cfx_sumo.drive.sumo_process import command_line, started
from cfx_sumo.installed import require_sumo
from cfx_sumo.live.fleet import Fleet
from cfx_sumo.live.policies import load_policy

STEPS_S = (0.1, 0.5, 1.0)
"""s: steps of SUMO at which what needs it is measured."""

REFERENCE = CAR.replace('sigma="0" tau="1"', 'sigma="0.5" tau="1.4"')
"""SUMO's Krauss with a usual saturation flow (1,760 vehicles/h, measured at 50 km/h)."""

_KIND = "car"
_TOWN_S = 600.0
_DROP_FROM_S, _DROP_S = 300.0, 900.0
"""When the queue before a lane drop has formed, and until when it is counted, s."""

_DROP = Scenario(
    "a lane drop",
    f'<routes>{CAR}<route id="r" edges="wide narrow"/><flow id="car" type="car" route="r" begin="0"'
    ' end="100000" vehsPerHour="2600" departLane="random" departSpeed="desired" departPos="base"/>'
    "</routes>",
    ASSETS / "town.net.xml",
    1e5,
)

Act = Callable[[Any, int], None]
"""Looks at a simulation after each of its steps."""


@dataclass(frozen=True)
class TrafficReport:
    """What `measure_traffic` found.

    Attributes:
        run: whose traffic it is.
        recorded: flows of recorded drivers.
        alone: what was measured without SUMO.
        measures: all values, in order.
        missing: why something was not measured, a sentence; "" where everything was.
    """

    run: str
    recorded: traffic.RecordedFlows
    alone: traffic.DriverTraffic
    measures: tuple[traffic.Measure, ...]
    missing: str = ""


def measure_traffic(
    run: str | Path,
    *,
    recorded: str | Path = "human",
    steps: Sequence[float] = STEPS_S,
    seed: int = 0,
    sumo_options: Sequence[str] = (),
) -> TrafficReport:
    """Measures the traffic of a driver.

    Args:
        run: a job's output folder, the id of its MLflow run, or `cfx://NAME`.
        recorded: flows to compare with, as `cfx.plugin.traffic.recorded_flows` takes them.
        steps: of SUMO, s.
        seed: of starts, of SUMO, and of what a stochastic policy leaves to chance.
        sumo_options: more of SUMO's own options.

    Raises:
        DataError: the run has no policy that drives unseen drivers, or there are no such flows.
        SumoError: SUMO stops.
    """
    flows = traffic.recorded_flows(recorded)
    policy = load_policy(run)
    missing = ""
    try:
        require_sumo()
    except NotInstalledError as error:
        steps = ()
        missing = f"A light, a lane drop and a town were not measured: {error}"
    with Task("Measuring traffic", 1 + 4 * len(steps)) as task:
        alone = traffic.driver_traffic(policy, recorded=flows, seed=seed)
        task.advance()
        measures = list(alone.measures)
        for step in steps:
            measures += _with_sumo(run, step, seed, tuple(sumo_options), task.advance)
    return TrafficReport(str(run), flows, alone, tuple(measures), missing)


def _with_sumo(
    run: str | Path, step: float, seed: int, options: tuple[str, ...], advance: Callable[[], Any]
) -> list[traffic.Measure]:
    """Returns what needs SUMO, at one step of it."""

    def fleet() -> Fleet:
        return Fleet.load({_KIND: run}, seed=seed)

    def drive(scenario: Scenario, drivers: Fleet | None, seconds: float, act: Act) -> None:
        _simulate(scenario, drivers, seconds, step, seed, options, act)
        advance()

    queue = QueueAtLight()
    drive(queue_of(), fleet(), SECONDS, queue.act)
    measures = []
    flow, lost = float("nan"), float("nan")
    if queue.is_measured:
        flow, lost = queue.saturation_flow, queue.lost_time
    measures.append(traffic.Measure.of("saturation_flow", flow, step))
    measures.append(traffic.Measure.of("start_up_lost_time", lost, step))
    passed = _Arrivals(_DROP_FROM_S)
    drive(_DROP, fleet(), _DROP_S, passed)
    discharge = passed.count * 3600.0 / (_DROP_S - _DROP_FROM_S)
    measures.append(traffic.Measure.of("discharge", discharge, step))
    town = SCENARIOS["town"]
    arrived, of_sumo = _Arrivals(), _Arrivals()
    drive(town, fleet(), _TOWN_S, arrived)
    usual = town._replace(routes=town.routes.replace(CAR, REFERENCE))
    drive(usual, None, _TOWN_S, of_sumo)
    share = arrived.count / max(1, of_sumo.count)
    measures.append(traffic.Measure.of("town_throughput", share, step))
    return measures


class _Arrivals:
    """Counts vehicles that arrive after some time, s."""

    def __init__(self, after: float = 0.0) -> None:
        self.count = 0
        self._after = after

    def __call__(self, sumo: Any, step: int) -> None:
        if sumo.simulation.getTime() > self._after:
            self.count += sumo.simulation.getArrivedNumber()


def _simulate(
    scenario: Scenario,
    fleet: Fleet | None,
    seconds: float,
    step: float,
    seed: int,
    options: tuple[str, ...],
    act: Act,
) -> None:
    """Runs a scenario with a fleet, or with SUMO's own models where there is none."""
    with ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="cfx-"))
        configuration = scenario.write(Path(folder), 1e5)
        line = command_line(configuration, options, step=step, seed=seed)
        sumo = stack.enter_context(started(configuration, line, gui=False))
        for number in range(round(seconds / step)):
            sumo.simulationStep()
            act(sumo, number)
            if fleet is not None:
                fleet.step(sumo)


def write_traffic(report: TrafficReport, folder: Path, command: str) -> list[Path]:
    """Writes tables (`.csv`), what a card needs (`traffic.json`) and a figure (`traffic.png`).

    The tables are `traffic`, `flows` by speed, `rings`, `platoon` and `time_gaps` of a fleet.

    Args:
        report: what was measured.
        folder: made if it is not there.
        command: that measured it.

    Returns:
        The files.

    Raises:
        OutputError: the folder cannot be written.
    """
    alone = report.alone
    speeds = np.array(traffic.SPEEDS_MPS)
    recorded = report.recorded.at(speeds)
    flows = []
    for number, speed in enumerate(speeds):
        row: dict[str, object] = {"speed_mps": speed, "recorded": recorded[number]}
        for start, value in zip(traffic.TIME_GAPS_S, alone.equilibrium[number], strict=True):
            row[f"from_{start:g}_s"] = value
        flows.append(row)
    gaps = _gap_rows(report)
    rings = [{"density": density, "flow": flow} for density, flow in alone.ring]
    dips = [{"vehicle": number, "dip_mps": dip} for number, dip in enumerate(alone.dips)]
    tables: dict[str, Sequence[dict[str, Any]]] = {
        "traffic.csv": traffic.table_of(report.measures),
        "flows.csv": flows,
        "rings.csv": rings,
        "platoon.csv": dips,
        "time_gaps.csv": gaps,
    }
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, rows in tables.items():
            with (folder / name).open("w", newline="", encoding="utf-8") as file:
                writer = csv.DictWriter(file, list(rows[0]))
                writer.writeheader()
                writer.writerows(rows)
        files.write_json(folder / "traffic.json", card_of(report, command))
    except OSError as error:
        raise OutputError(
            f"{folder} cannot be written ({error.strerror}); name another folder"
        ) from error
    # Its imports take seconds, and nothing else here draws.
    from cfx.plugin import drawing
    from cfx_sumo.drive.traffic_figure import draw_traffic

    picture = drawing.write_figure(draw_traffic(report), folder / "traffic.png")
    return [*(folder / name for name in tables), folder / "traffic.json", picture]


def card_of(report: TrafficReport, command: str) -> dict[str, Any]:
    """Returns what stands on a policy's card, as `traffic.json` holds it."""
    rows = []
    for measure in report.measures:
        rows.append(
            {
                "measure": measure.name,
                "meaning": measure.title,
                "step_s": measure.step,
                "value": None if np.isnan(measure.value) else round(measure.value, 4),
                "text": f"{measure.text} {measure.unit}".strip(),
                "usual": measure.usual,
                "outside": measure.word,
            }
        )
    driven, recorded = report.alone.time_gaps, report.recorded.time_gaps()
    gaps = []
    if not np.isnan(driven).any():
        for place, speed in enumerate(traffic.FLEET_SPEEDS_MPS):
            quantiles = {"driven_s": driven[place], "recorded_s": recorded[place]}
            rounded = {name: np.round(values, 3).tolist() for name, values in quantiles.items()}
            gaps.append({"speed_mps": speed, **rounded})
    return {
        "command": command,
        "recorded": report.recorded.of,
        "rows": rows,
        "time_gaps": gaps,
    }


def _gap_rows(report: TrafficReport) -> list[dict[str, object]]:
    """Returns quantiles of time gaps, s, of a fleet and of recorded drivers."""
    driven, recorded = report.alone.time_gaps, report.recorded.time_gaps()
    rows: list[dict[str, object]] = []
    for place, speed in enumerate(traffic.FLEET_SPEEDS_MPS):
        for number, share in enumerate(traffic.FLEET_SHARES):
            rows.append(
                {
                    "speed_mps": speed,
                    "share": share,
                    "driven_s": driven[place, number],
                    "recorded_s": recorded[place, number],
                }
            )
    return rows


def print_traffic(report: TrafficReport) -> None:
    """Prints a table: what was measured, what is usual, and a red word outside."""
    from cfx.plugin import console

    table = console.blank_table("traffic of " + report.run, "step [s]", "measured", "usual", "")
    for column in table.columns[1:4]:
        column.justify = "right"
    for measure in report.measures:
        value = f"{measure.text} {measure.unit}".strip()
        table.add_row(
            measure.title, f"{measure.step:g}", value, measure.usual, Text(measure.word, "red")
        )
    console.print_table(table)
    print(
        f"Flows of equilibria beside those of recorded drivers ({report.recorded.of}), within"
        f" {traffic.FLOW_TOLERANCE:.0%}."
    )
    driven, recorded = report.alone.time_gaps, report.recorded.time_gaps()
    if np.isnan(driven).any():
        print("All vehicles have one average driver: the policy knows no drivers to draw from.")
    else:
        for speed, of_fleet, there in zip(traffic.FLEET_SPEEDS_MPS, driven, recorded, strict=True):
            print(
                f"Time gaps of a fleet at {speed:g} m/s (25, 50, 75 % of drivers):"
                f" {_seconds(of_fleet)} s; recorded {_seconds(there)} s"
            )
    if report.missing:
        print(report.missing)


def _seconds(values: Sequence[float]) -> str:
    return ", ".join(f"{value:.2f}" for value in values)


def check_alone(runs: dict[str, str]) -> str:
    """Returns the run that drives the vType `car`.

    Raises:
        SumoError: other vTypes are named.
    """
    if set(runs) != {_KIND}:
        raise SumoError(f"the stress scenario drives vType '{_KIND}' alone: --drivers {_KIND}=RUN")
    return runs[_KIND]
