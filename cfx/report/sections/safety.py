"""Safety and string stability of every method."""

from __future__ import annotations

from collections.abc import Sequence

from cfx.metrics.base import key_of
from cfx.plots.choice.platoon import platoon_panels
from cfx.plots.plotly.figure import Plot
from cfx.plots.plotly.platoon import platoon_plot
from cfx.plots.words import MINUS
from cfx.report.blocks import Block, Figure, Fold, Heading, Section, Table, Text, job_fold
from cfx.report.job import Job, Runs
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
_PLATOONS = (
    "All followers use the same method, each behind the vehicle ahead; the leader brakes from 15 to"
    " 7 m/s at 2 m/s², waits 10 s and recovers at 1 m/s². A string stable platoon damps the"
    " disturbance: no vehicle slows down more than the vehicle ahead. One that had not settled"
    " before, or in which vehicles collide, does not count as stable. Dark lines are the first"
    " followers, light ones the last. Of several networks the one is shown whose last follower"
    " becomes slowest."
)
_OLDER = "An older version of cfx wrote these jobs: they have no measure of it but the collisions."


def blocks(runs: Runs) -> list[Block]:
    """Returns a table of all methods, and the platoons."""
    sheet = safety_of_methods(runs.jobs)
    found: list[Block] = [Text(_OLDER)]
    if sheet.rows:
        table = Table(sheet, compact=True)
        found = [Fold("Every method of every job", (Text(_METHODS), table))]
    for job in runs.jobs:
        for scope, words in job.outside.items():
            found.append(Text(f"{job.name}, {job.scope_label(scope)}: {words}."))
    with_platoon = [job for job in runs.jobs if job.platoon is not None]
    if with_platoon:
        found += [Heading("Ten followers in a row"), Text(_PLATOONS)]
    for k, job in enumerate(with_platoon):
        found.append(job_fold(job.name, [Figure(platoon(job))], first=k == 0))
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


def platoon(job: Job) -> Plot:
    """Speeds of the platoons of a job that has them, a panel per method."""
    assert job.platoon is not None
    present = set(job.platoon["method"])
    methods, stable = [], {}
    for method in job.meaningful_methods:
        if method not in present:
            continue
        methods.append(method)
        key = key_of("platoon/string_stable", method)
        if key in job.metrics:
            stable[method] = job.metrics[key]
    return platoon_plot(platoon_panels(job.platoon, methods, stable))


SECTION = Section("safety", "Safety and string stability", "Safety", blocks)
