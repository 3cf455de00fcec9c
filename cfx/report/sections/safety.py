"""Safety and string stability of every method."""

from __future__ import annotations

from collections.abc import Sequence

from cfx.report.blocks import Block, Fold, Heading, Table, Text
from cfx.report.figure_blocks import caption, figure_folds
from cfx.report.figures.words import MINUS
from cfx.report.job import Job, Runs
from cfx.report.section import Section
from cfx.report.tables import Column, Sheet, formatted, method_cell, number, text

_COLUMNS = (
    ("Collisions", "collisions", ".0f"),
    ("Hard braking", "hard_braking", ".0f"),
    ("Jerk (m/s³)", "jerk", ".2f"),
    ("At bounds", "at_bounds", ".1%"),
    ("At limits", "at_limits", ".1%"),
    ("Outside", "outside_range", ".1%"),
    ("last / leader", "platoon/head_to_tail", ".2f"),
    ("last / first", "platoon/amplification", ".2f"),
    ("Stable", "platoon/string_stable", ".0%"),
    ("Settled", "platoon/settled", ".0%"),
    ("Least gap (m)", "platoon/min_gap", ".1f"),
    ("Collisions", "platoon/collisions", ".0f"),
    ("Hard braking", "platoon/hard_braking", ".0f"),
)

_METHODS = (
    "Slowing down of the last follower divided by that of the leader, and by that of the first"
    " follower; shares of the networks whose platoons are string stable, and had settled before the"
    f" leader braked. Hard braking counts frames below {MINUS}8 m/s². At limits:"
    " share of frames at a limit of acceleration, where the guard steps in. Outside: share of"
    " frames outside what the policy has learned from."
)
_OLDER = "An older version of cfx wrote these jobs: they have no measure of it but the collisions."


class SafetySection(Section):
    """Safety and string stability of every method."""

    title = "Safety and string stability"
    entry = "Safety"
    order = 500

    def blocks(self, runs: Runs) -> list[Block]:
        """Return a table of all methods, and the platoons."""
        sheet = safety_of_methods(runs.jobs)
        found: list[Block] = [Text(_OLDER)]
        if sheet.rows:
            table = Table(sheet, compact=True)
            found = [Fold("Every method of every job", (Text(_METHODS), table))]
        for job in runs.jobs:
            for scope, words in job.outside.items():
                found.append(Text(f"{job.name}, {job.scope_label(scope)}: {words}."))
        folds = figure_folds("platoon", runs)
        if folds:
            found += [Heading("Ten followers in a row"), Text(caption("platoon")), *folds]
        return found


def safety_of_methods(jobs: Sequence[Job]) -> Sheet:
    """Returns a row per job and method, with the recorded drivers for comparison."""
    columns = [
        Column("Job", number=False),
        Column("Driven by", "The method; real: the recorded drivers.", number=False),
    ]
    platoon = 0
    for heading, metric, _ in _COLUMNS:
        columns.append(Column(heading))
        platoon += metric.startswith("platoon/")
    recorded = len(_COLUMNS) - platoon
    groups = (("", 2), ("Behind recorded leaders, test part", recorded), ("Platoon", platoon))
    rows = []
    for job in jobs:
        for method in ("real", *job.meaningful_methods):
            cells = []
            for _, metric, form in _COLUMNS:
                value = job.metric(metric, method)
                cells.append(number(value, formatted(value, form)))
            if any(cell.sort for cell in cells):
                rows.append((text(job.name), method_cell(method), *cells))
    return Sheet(tuple(columns), tuple(rows), groups)
