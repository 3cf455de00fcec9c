"""What `cfx drive` prints of a scenario that it has run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from cfx_sumo.drive.tally import CollisionCounts, ScenarioRun

if TYPE_CHECKING:
    from rich.table import Table

_QUANTILES = (0.05, 0.5, 0.95)
"""Quantiles by which live traffic is compared with the recording."""

_LISTED = 10
"""Collisions, and vehicles left out, that are listed."""


def report(run: ScenarioRun) -> None:
    """Prints what happened: tables, and one line about speed."""
    from cfx.plugin import console

    console.print_table(_what_happened(run))
    console.print_table(_braking(run))
    console.print_table(_beside_the_recording(run))
    for collision in run.collisions[:_LISTED]:
        print(collision)
    if len(run.collisions) > _LISTED:
        print(f"... and {len(run.collisions) - _LISTED} more collisions")
    if any(not collision.contact for collision in run.collisions):
        print(
            "SUMO takes a gap below minGap for a collision, and teleports the vehicle unless the"
            " scenario says otherwise; -- --collision.mingap-factor 0 leaves contact alone"
        )
    for sentence in run.left_out[:_LISTED]:
        print(f"left out by SUMO: {sentence}")
    if len(run.left_out) > _LISTED:
        print(f"... and {len(run.left_out) - _LISTED} more vehicles and flows left out")
    if run.collisions_of_sumo is not None:
        behind = sum(tally.collisions for tally in run.tallies.values())
        crossings = sum(tally.crossings for tally in run.tallies.values())
        print(
            f"Collisions: {CollisionCounts(behind, crossings)}; where SUMO's own models drive all"
            f" of them in the same scenario: {run.collisions_of_sumo}"
        )
    for name, words in run.fleets.items():
        print(f"{name}: {words}")
    for name, words in run.expected.items():
        if words:
            print(f"{name}: {words}")
    for name, words in run.outside.items():
        if words:
            print(f"{name}: {words}; there it fades towards its base parameters")
    print(
        f"{run.steps} steps of {run.dt:g} s in {run.seconds:.1f} s, {run.real_time:.1f} times real"
        f" time; at most {run.most} of these vehicles at once, {run.others} others"
    )


def _what_happened(run: ScenarioRun) -> Table:
    table = _table(
        "vType",
        "vehicles",
        "behind a leader",
        "mean speed [m/s]",
        "lane changes",
        "collisions",
        "below minGap",
        "crossing paths",
        "teleports",
    )
    for name, tally in run.tallies.items():
        table.add_row(
            name,
            str(len(tally.vehicles)),
            f"{tally.behind / tally.steps:.0%}",
            f"{tally.metres / (tally.steps * run.dt):.2f}",
            str(tally.lane_changes),
            str(tally.collisions),
            str(tally.below_min_gap),
            str(tally.crossings),
            str(tally.teleports),
        )
    return table


def _braking(run: ScenarioRun) -> Table:
    """Returns how hard vehicles braked, m/s2."""
    table = _table(
        "braking [m/s2]",
        "95 % of steps below",
        "99.9 % below",
        "hardest",
        "times above decel",
        "steps at limits",
        "changed by SUMO",
    )
    for name, tally in run.tallies.items():
        table.add_row(
            name,
            f"{tally.braking.quantile(0.95):.2f}",
            f"{tally.braking.quantile(0.999):.2f}",
            f"{tally.hardest_braking:.2f}",
            str(tally.hard_brakings),
            f"{run.limited.get(name, 0.0):.1%}",
            f"{run.changed.get(name, 0.0):.1%}",
        )
    return table


def _beside_the_recording(run: ScenarioRun) -> Table:
    """Returns quantiles of the live vehicles beside those of what their policy learned from."""
    table = _table("5 %, median, 95 %", "speed [m/s]", "acceleration [m/s2]", "time gap [s]")
    for name, tally in run.tallies.items():
        live = []
        for histogram in (tally.speeds, tally.accelerations, tally.time_gaps):
            live.append(_listed([histogram.quantile(share) for share in _QUANTILES]))
        table.add_row(name, *live)
        recorded = run.recorded.get(name) or {}
        if recorded:
            signals = ("speed", "acceleration", "time_gap")
            table.add_row("its recording", *(_listed(recorded[signal]) for signal in signals))
    return table


def _table(*columns: str) -> Table:
    from cfx.plugin import console

    table = console.blank_table(*columns)
    for column in table.columns[1:]:
        column.justify = "right"
    return table


def _listed(values: Sequence[float]) -> str:
    return ", ".join(f"{value:.2f}" for value in values)
